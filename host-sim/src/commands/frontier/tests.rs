use super::*;
use crate::commands::certified;
use crate::engine::{RunOptions, Silent, run};
use crate::scenario::Window;
use agent_core::observer::field::Coupling;

fn parse(more: &str) -> Scenario {
    Scenario::parse("paper.toml", &format!("{PAPER}{more}")).unwrap()
}

#[test]
fn the_papers_plant_has_the_settings_of_the_study() {
    let scenario = parse("");
    let forms = Forms::new(&scenario).unwrap();
    for form in Form::DEFAULT {
        for variant in forms.variants(form) {
            let observer = variant.scenario.observer.as_ref();
            assert_eq!(observer.is_none(), form == Form::Paper, "{form:?}");
            assert!(observer.is_none_or(|o| o.from == 20.0 && o.is_complete()), "{observer:?}");
            assert!(matches!(variant.level, Level::Radius(_)));
        }
    }
    let own: Vec<_> =
        forms.variants(Form::Paper).into_iter().filter(|variant| variant.is_own).collect();
    assert_eq!(own.len(), 1);
    assert_eq!(own[0].scenario.design, scenario.design);
    let split = &forms.variants(Form::Split)[0].scenario.observer;
    let split = split.as_ref().unwrap();
    assert_eq!(split.coupling, Coupling::Held);
    assert_eq!(split.tree_gain, Some(vec![43.5, 58.825, 58.825]));
}

#[test]
fn own_keys_take_precedence_and_errors_are_varied_where_settings_are_derived() {
    let scenario = parse("\n[observer]\ntree_gain = 150.0\nprecision = 16\n");
    let forms = Forms::new(&scenario).unwrap();
    for form in [Form::Flow, Form::FlowEso, Form::NoNetwork] {
        for variant in forms.variants(form) {
            let observer = variant.scenario.observer.unwrap();
            assert!(matches!(variant.level, Level::Error(error) if error == observer.error));
            assert_eq!(observer.tree_gain, Some(vec![150.0; 3]));
            assert!(observer.is_half && observer.from == 0.0);
        }
    }
}

#[test]
fn initial_states_begin_with_the_scenarios_own_and_stay_within_its_course() {
    let states = initial_states(&parse(""), 50, 3).unwrap();
    assert_eq!(states[0], [5.0, 7.0, 8.0]);
    assert_eq!(states.len(), 50);
    // The second component grows before it settles.
    let limits = [5.0, 15.0, 8.0];
    let within = |x: &Vec<f64>| x.iter().zip(limits).all(|(x, limit)| x.abs() <= limit);
    assert!(states.iter().all(within), "{states:?}");
    assert_ne!(states[1], states[2]);
}

fn point(form: Form, broadcasts: u64, rmse: f64) -> Point {
    Point {
        form,
        radius: Some(0.1),
        wanted_error: None,
        period: None,
        seed: 0,
        initial_state: 1,
        broadcasts: Some(broadcasts),
        bytes: Some(50 * broadcasts),
        rmse: vec![Some(rmse)],
        certified: true,
        bound: Some(1.0),
        failure: None,
        frames: vec![
            crate::commands::radio::Frames { count: broadcasts, bytes: 50 * broadcasts };
            3
        ],
    }
}

#[test]
fn the_best_setting_has_the_fewest_broadcasts_within_the_target_in_every_run() {
    let runs = [
        [point(Form::Flow, 100, 0.01), point(Form::Flow, 120, 0.09)],
        [point(Form::Flow, 200, 0.02), point(Form::Flow, 220, 0.03)],
        [point(Form::Flow, 400, 0.01), point(Form::Flow, 420, 0.01)],
    ];
    let settings: Vec<_> = runs
        .iter()
        .map(|points| Setting {
            form: Form::Flow,
            level: Level::Radius(0.1),
            is_own: false,
            points,
        })
        .collect();
    let scenario = parse("");
    let found = summary::best(&settings, &[0.05], &scenario.graph, 20.0);
    let text = summary::text(&found, &[0.05], "the target");
    assert!(text.contains("210") && !text.contains('*'), "{text}");
    let found = summary::best(&settings, &[0.001], &scenario.graph, 20.0);
    let text = summary::text(&found, &[0.001], "the target");
    assert!(text.contains("flow*") && text.contains("410"), "{text}");
}

#[test]
fn runs_are_certified_unless_they_depart_from_what_the_theorems_allow_for() {
    let mut scenario = parse("");
    scenario.learning.clear();
    scenario.time.duration = 0.4;
    scenario.evaluation = Window { from: 0.3, to: 0.4 };
    let forms = Forms::new(&scenario).unwrap();
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    for form in [Form::Paper, Form::Split, Form::Flow, Form::FlowEso, Form::NoNetwork] {
        let mut variant = forms.variants(form).swap_remove(1);
        let result = run(&variant.scenario, options, &Silent).unwrap();
        let bound = certified::bound(&variant.scenario, &result.trainings).ok();
        let squared = result.agents.iter().filter_map(|agent| agent.rmse()).map(|e| e * e);
        let error = squared.sum::<f64>().sqrt();
        assert!(bound.is_some_and(|bound| bound > error), "{form:?}: {bound:?}, {error}");
        variant.scenario.exchange.gap = 5;
        assert!(certified::bound(&variant.scenario, &result.trainings).is_err(), "{form:?}");
    }
}
