//! Trials of packages with steps of 1/64 s, so that a block is a second.

use super::*;

const STEP: f32 = 1.0 / 64.0;
const BEFORE: Means = Means {
    innovation: 4.0,
    disagreement: 9.0,
    heard: 1.0,
    broadcasts: 0.25,
    effort: 2.0,
    output: 100.0,
    faults: 0.0,
};
const LIMITS: TrialLimits = TrialLimits { seconds: Some(20), ..TrialLimits::NONE };

/// Blocks of an attempt: those in 20 s, rounded up.
const NEEDED: u32 = 21;

/// Runs a trial of blocks with these means and tallies, from the second on; returns the verdict and
/// the second in which it was reached.
fn run(
    limits: &TrialLimits,
    before: Option<Means>,
    block: impl Fn(u32) -> (Means, Tally),
) -> (Verdict, u32) {
    let mut trial = Trial::new(limits, before, STEP, 1_000);
    for second in 1..10_000 {
        let (means, tally) = block(second);
        let tick = 1_000 + Tick::from(BLOCK * second) - 1;
        let verdict = trial.end_block(&Block { taken: BLOCK, means }, &tally, tick);
        if matches!(verdict, Verdict::Passed | Verdict::Failed(_)) {
            assert_eq!(trial.verdict(), verdict);
            return (verdict, second);
        }
    }
    (trial.verdict(), 10_000)
}

fn with(change: impl Fn(&mut Means)) -> (Verdict, u32) {
    let mut means = BEFORE;
    change(&mut means);
    run(&LIMITS, Some(BEFORE), |_| (means, Tally::default()))
}

#[test]
fn a_package_as_good_as_the_one_before_passes_after_one_attempt() {
    assert_eq!(with(|_| {}), (Verdict::Passed, NEEDED));
    assert_eq!(with(|means| means.innovation *= 1.5), (Verdict::Passed, NEEDED));
    assert_eq!(with(|means| means.broadcasts *= 1.9), (Verdict::Passed, NEEDED));
}

#[test]
fn what_is_worse_fails_as_soon_as_no_attempt_can_pass() {
    for (reason, change) in [
        (RevertReason::Innovation, (|means| means.innovation *= 20.0) as fn(&mut Means)),
        (RevertReason::Effort, |means| means.effort *= 20.0),
        (RevertReason::Effort, |means| means.effort = f32::NAN),
        (RevertReason::Disagreement, |means| means.disagreement *= 20.0),
        (RevertReason::Disagreement, |means| means.disagreement = f32::NAN),
        (RevertReason::Disagreement, |means| (means.heard, means.disagreement) = (0.0, 0.0)),
        (RevertReason::Broadcasts, |means| means.broadcasts = 1.0),
        (RevertReason::Faults, |means| means.faults = 1.0),
    ] {
        let (verdict, second) = with(change);
        assert_eq!(verdict, Verdict::Failed(reason));
        // Never after the deadline, and not before the last attempt has become impossible.
        assert!((2 * NEEDED - 1..=3 * NEEDED).contains(&second), "{reason:?}: {second}");
    }
}

#[test]
fn a_transient_after_the_switch_costs_an_attempt_and_not_the_trial() {
    let transient = |second| {
        let innovation = if second < 5 { 200.0 } else { 4.0 };
        (Means { innovation, ..BEFORE }, Tally::default())
    };
    assert_eq!(run(&LIMITS, Some(BEFORE), transient), (Verdict::Passed, NEEDED + 4));
}

/// An erasure in the middle of an attempt, as for a key.
#[test]
fn a_chip_that_stands_still_costs_a_block_and_not_the_attempt() {
    let stalled = |second| {
        let stalled_ticks = u32::from(second == 10) * 2_000;
        let innovation = if second == 10 { 200.0 } else { 4.0 };
        (Means { innovation, ..BEFORE }, Tally { stalled_ticks, ..Tally::default() })
    };
    assert_eq!(run(&LIMITS, Some(BEFORE), stalled), (Verdict::Passed, NEEDED + 1));
    // But the first block shows whether the package knows what is measured.
    let first = |second| {
        let (means, tally) = stalled(second + 9);
        (Means { innovation: 100.0 * means.innovation, ..means }, tally)
    };
    let found = run(&LIMITS, Some(BEFORE), first);
    assert_eq!(found, (Verdict::Failed(RevertReason::Innovation), 1));
}

#[test]
fn an_estimate_that_no_longer_fits_the_measurement_at_the_switch_ends_it_at_once() {
    for innovation in [300.0, 1e30, f32::INFINITY, f32::NAN] {
        let first = |second| {
            let innovation = if second == 1 { innovation } else { 4.0 };
            (Means { innovation, ..BEFORE }, Tally::default())
        };
        let found = run(&LIMITS, Some(BEFORE), first);
        assert_eq!(found, (Verdict::Failed(RevertReason::Innovation), 1));
    }
}

#[test]
fn a_restart_too_many_does_not_wait_for_the_end_of_a_block() {
    let limits = TrialLimits { restarts: Some(2), ..LIMITS };
    let mut trial = Trial::new(&limits, Some(BEFORE), STEP, 0);
    let restarts = |restarts| Tally { restarts, ..Tally::default() };
    trial.end_block(&Block { taken: BLOCK, means: BEFORE }, &restarts(1), 63);
    assert_eq!(trial.happened(&restarts(1)), Verdict::Running);
    assert_eq!(trial.happened(&restarts(2)), Verdict::Failed(RevertReason::Restarts));
}

#[test]
fn limits_of_the_whole_trial_end_it_at_once() {
    let limits =
        TrialLimits { restarts: Some(2), overflows: Some(5), skipped_ticks: Some(9), ..LIMITS };
    for (reason, tally, second) in [
        (RevertReason::Restarts, Tally { restarts: 1, ..Tally::default() }, 3),
        (RevertReason::Overflows, Tally { overflows: 2, ..Tally::default() }, 3),
        (RevertReason::SkippedTicks, Tally { skipped_ticks: 10, ..Tally::default() }, 1),
    ] {
        let found = run(&limits, Some(BEFORE), |_| (BEFORE, tally));
        assert_eq!(found, (Verdict::Failed(reason), second));
    }
    // Counts beyond every limit do not wrap.
    let tally = Tally { restarts: u32::MAX, ..Tally::default() };
    let found = run(&LIMITS, Some(BEFORE), |_| (BEFORE, tally));
    assert_eq!(found, (Verdict::Passed, NEEDED));
}

#[test]
fn a_bound_in_the_package_is_enough_and_the_tighter_one_applies() {
    let bound = |innovation_rms| TrialLimits { innovation_rms: Some(innovation_rms), ..LIMITS };
    let steady = |_| (BEFORE, Tally::default());
    assert_eq!(run(&bound(2.0), None, steady), (Verdict::Passed, NEEDED));
    for (limits, before) in
        [(bound(1.9), None), (bound(1.9), Some(BEFORE)), (bound(f32::NAN), Some(BEFORE))]
    {
        let (verdict, _) = run(&limits, before, steady);
        assert_eq!(verdict, Verdict::Failed(RevertReason::Innovation));
    }
    // Promised broadcasts replace the comparison with the package before.
    let promise = TrialLimits { broadcasts_per_second: Some(64.0), ..LIMITS };
    let always = |_| (Means { broadcasts: 1.0, ..BEFORE }, Tally::default());
    assert_eq!(run(&promise, Some(BEFORE), always), (Verdict::Passed, NEEDED));
}

#[test]
fn what_does_not_compare_is_left_to_the_operator_within_limits() {
    let limits = TrialLimits { restarts: Some(2), innovation_rms: Some(9.0), ..LIMITS };
    let trial = || Trial::new(&limits, Some(BEFORE), STEP, 0).left_to_operator();
    let (block, tally) = (Block { taken: BLOCK, means: BEFORE }, Tally::default());
    let mut good = trial();
    for second in 1..3 * NEEDED {
        let tick = Tick::from(BLOCK * second) - 1;
        assert_eq!(good.end_block(&block, &tally, tick), Verdict::AwaitsOperator, "{second}");
    }
    let end = Tick::from(3 * NEEDED * BLOCK);
    assert_eq!(good.at(end), Verdict::Failed(RevertReason::NotConfirmed));
    let restarts = Tally { restarts: 3, ..tally };
    assert_eq!(trial().happened(&restarts), Verdict::Failed(RevertReason::Restarts));
}

#[test]
fn without_anything_to_compare_with_only_the_operator_confirms() {
    let mut trial = Trial::new(&LIMITS, None, STEP, 0);
    assert_eq!(trial.verdict(), Verdict::AwaitsOperator);
    let found = run(&LIMITS, None, |_| (BEFORE, Tally::default()));
    assert_eq!(found, (Verdict::Failed(RevertReason::NotConfirmed), 3 * NEEDED + 1));
    trial.end(Verdict::Passed);
    assert_eq!(trial.at(Tick::MAX), Verdict::Passed);
}

#[test]
fn a_trial_without_measurements_ends_too() {
    let mut trial = Trial::new(&LIMITS, Some(BEFORE), STEP, 0);
    let empty = Block { taken: BLOCK / 2 - 1, means: BEFORE };
    for second in 1.. {
        match trial.end_block(&empty, &Tally::default(), Tick::from(BLOCK * second)) {
            Verdict::Running => assert!(second <= 2 * NEEDED),
            verdict => {
                assert_eq!(verdict, Verdict::Failed(RevertReason::Measurements));
                assert_eq!(second, 2 * NEEDED + 1);
                break;
            }
        }
    }
}

#[test]
fn the_length_of_a_trial_is_limited() {
    for (seconds, needed) in [
        (None, 10.0),
        (Some(0), 10.0),
        (Some(600), 600.0),
        (Some(86_400), 86_400.0),
        (Some(u32::MAX), 86_400.0),
    ] {
        let limits = TrialLimits { seconds, ..TrialLimits::NONE };
        let [_, found, deadline] = Trial::new(&limits, None, STEP, 0).seconds();
        assert!((needed..=needed + 1.0).contains(&found), "{found}");
        assert_eq!(deadline, 3.0 * found);
    }
    // Steps that no clock has do not make a trial that never ends, nor one without a block.
    for step_size in [1e-45, 1e-30, 1e6, 1e38] {
        let (_, needed) = Trial::new(&LIMITS, None, step_size, 0).steps();
        assert!((BLOCK..=1 << 31).contains(&needed.get()), "{step_size}: {needed}");
    }
}

#[test]
fn reasons_have_their_codes_and_names() {
    for (code, reason) in RevertReason::ALL.into_iter().enumerate() {
        assert_eq!(usize::from(reason.code()), code);
        assert_eq!(RevertReason::from_code(reason.code()), reason);
        let mut encoded = [0; 4];
        let length = postcard::to_slice(&reason, &mut encoded).unwrap().len();
        assert_eq!((length, encoded[0]), (1, reason.code()));
    }
}
