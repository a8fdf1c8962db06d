use super::*;
use crate::wire::secret::Secret;

const KEY: NetworkKey = NetworkKey::new(1, Secret::new([9; 16]));
const PARAMS: TrustParams = TrustParams { hello_interval: 250, answer_gap: 100 };

/// Agent 1 or 2, whose neighbour is the other one.
fn trust(own: AgentId, epochs: (u32, u32)) -> Trust<1> {
    let mut trust = Trust::new(own, epochs, PARAMS);
    assert!(trust.set_neighbours(&[neighbour(3 - own)], PARAMS));
    trust
}

fn neighbour(id: AgentId) -> Neighbour {
    Neighbour { id, weight: 1.0 }
}

fn sampled(sender: AgentId, sequence: u32) -> Frame<1> {
    let estimate = [f32::from(sequence as u16)].into();
    Frame::new(sender, sequence, 10 * Tick::from(sequence), estimate)
}

/// Agent 1 and agent 2 after a boot with the given epochs.
fn pair(first: u32, second: u32) -> [Trust<1>; 2] {
    [(1, first), (2, second)].map(|(own, epoch)| trust(own, (epoch, epoch + 10)))
}

#[test]
fn a_neighbour_is_believed_after_its_answer() {
    let [mut one, mut two] = pair(5, 8);
    let first = two.seal(&sampled(2, 0), &KEY).unwrap();
    let refused = FrameError::NotBelieved { sender: 2 };
    assert_eq!(one.open::<1>(&[KEY], &first), Err(refused));

    let hello = one.hello(0, &KEY).unwrap();
    assert_eq!(one.hello(249, &KEY), None);
    assert_eq!(two.open::<1>(&[KEY], &hello), Ok(None));
    let sync = two.answer(&sampled(2, 0), 3, &KEY).unwrap();
    assert_eq!(two.answer(&sampled(2, 0), 4, &KEY), None);
    // The hello does not make agent 1 believed.
    assert!(!two.is_believed(0));

    assert_eq!(one.open(&[KEY], &sync), Ok(Some(sampled(2, 0))));
    assert!(one.is_believed(0));
    assert_eq!(one.open::<1>(&[KEY], &sync), Ok(None));
    assert_eq!(one.hello(1_000, &KEY), None);
    let replayed = FrameError::Replayed { sender: 2 };
    assert_eq!(one.open::<1>(&[KEY], &first), Err(replayed));
    let next = two.seal(&sampled(2, 1), &KEY).unwrap();
    assert_eq!(one.open(&[KEY], &next), Ok(Some(sampled(2, 1))));
    assert_eq!(one.open::<1>(&[KEY], &next), Err(replayed));
}

#[test]
fn an_answer_from_an_earlier_life_is_refused() {
    let [mut one, mut two] = pair(5, 8);
    let _ = two.seal(&sampled(2, 0), &KEY);
    let hello = one.hello(0, &KEY).unwrap();
    let _ = two.open::<1>(&[KEY], &hello);
    let sync = two.answer(&sampled(2, 0), 3, &KEY).unwrap();
    let mut rebooted = trust(1, (15, 25));
    let replayed = Err(FrameError::Replayed { sender: 2 });
    assert_eq!(rebooted.open::<1>(&[KEY], &sync), replayed);
    // Nor by a node that has no epoch of its own, even if the numbers match.
    let mut listening = trust(1, (5, 5));
    assert_eq!(listening.open::<1>(&[KEY], &sync), replayed);
    assert_eq!(listening.hello(0, &KEY), None);
    assert_eq!(listening.seal(&sampled(1, 0), &KEY), None);
}

#[test]
fn a_rebooted_sender_is_believed_at_once() {
    let [mut one, mut two] = pair(5, 8);
    let _ = two.seal(&sampled(2, 7), &KEY);
    let _ = two.open::<1>(&[KEY], &one.hello(0, &KEY).unwrap());
    let sync = two.answer(&sampled(2, 7), 3, &KEY).unwrap();
    assert!(one.open::<1>(&[KEY], &sync).is_ok());
    let mut rebooted = trust(2, (18, 28));
    let frame = rebooted.seal(&sampled(2, 0), &KEY).unwrap();
    assert_eq!(one.open(&[KEY], &frame), Ok(Some(sampled(2, 0))));
    // Its hello of the life before is no longer answered.
    let old = two.hello(10, &KEY).unwrap();
    let replayed = Err(FrameError::Replayed { sender: 2 });
    assert_eq!(one.open::<1>(&[KEY], &old), replayed);
}

#[test]
fn the_epoch_rises_when_the_sequence_starts_again() {
    let mut one = trust(1, (5, 7));
    assert!(one.seal(&sampled(1, 0), &KEY).is_some());
    assert!(one.seal(&sampled(1, u32::MAX), &KEY).is_some());
    assert_eq!(one.epochs_left(), 2);
    assert!(one.seal(&sampled(1, 0), &KEY).is_some());
    assert_eq!(one.epochs_left(), 1);
    // The next epoch has not been reserved.
    assert_eq!(one.seal(&sampled(1, 0), &KEY), None);
    one.extend((7, 9));
    assert!(one.seal(&sampled(1, 0), &KEY).is_some());
}

#[test]
fn a_repeated_hello_is_answered_at_most_once_in_the_gap() {
    let [mut one, mut two] = pair(5, 8);
    let _ = two.seal(&sampled(2, 0), &KEY);
    let hello = one.hello(0, &KEY).unwrap();
    let mut answers = 0;
    for now in 0..1_000 {
        assert_eq!(two.open::<1>(&[KEY], &hello), Ok(None));
        answers += u32::from(two.answer(&sampled(2, 0), now, &KEY).is_some());
    }
    assert_eq!(answers, 10);
}

#[test]
fn other_neighbours_do_not_make_recordings_believed_again() {
    let mut one = Trust::<2>::new(1, (5, 15), PARAMS);
    assert!(one.set_neighbours(&[neighbour(3)], PARAMS));
    let mut three = Trust::<2>::new(3, (40, 50), PARAMS);
    assert!(three.set_neighbours(&[neighbour(1)], PARAMS));
    let first = three.seal(&sampled(3, 0), &KEY).unwrap();
    let _ = three.open::<1>(&[KEY], &one.hello(0, &KEY).unwrap());
    let sync = three.answer(&sampled(3, 0), 3, &KEY).unwrap();
    assert!(one.open::<1>(&[KEY], &sync).unwrap().is_some());
    // A neighbour with a lower number is added: the other one stays believed.
    assert!(one.set_neighbours(&[neighbour(2), neighbour(3)], PARAMS));
    let replayed = Err(FrameError::Replayed { sender: 3 });
    assert_eq!(one.open::<1>(&[KEY], &first), replayed);
    assert!(one.is_believed(1) && !one.is_believed(0));
    // Left out and taken back, it has to answer a hello of the new epoch.
    assert!(one.set_neighbours(&[neighbour(2)], PARAMS));
    assert!(one.set_neighbours(&[neighbour(2), neighbour(3)], PARAMS));
    assert_eq!(one.open::<1>(&[KEY], &sync), replayed);
    assert!(!one.is_believed(1));
    let _ = three.open::<1>(&[KEY], &one.hello(10, &KEY).unwrap());
    let sync = three.answer(&sampled(3, 0), 200, &KEY).unwrap();
    assert!(one.open::<1>(&[KEY], &sync).unwrap().is_some());
}

/// A farewell is believed as an estimate is, and counts among them.
#[cfg(feature = "exchange")]
#[test]
fn a_farewell_has_a_stamp_of_its_own() {
    let [mut one, mut two] = pair(5, 8);
    let farewell = Frame::<1>::farewell(2, 8, 90);
    let sealed = two.seal(&farewell, &KEY).unwrap();
    let refused = FrameError::NotBelieved { sender: 2 };
    assert_eq!(one.open::<1>(&[KEY], &sealed), Err(refused));

    let _ = two.seal(&sampled(2, 9), &KEY);
    let _ = two.open::<1>(&[KEY], &one.hello(0, &KEY).unwrap());
    let sync = two.answer(&sampled(2, 9), 3, &KEY).unwrap();
    assert!(one.open::<1>(&[KEY], &sync).is_ok());
    let replayed = Err(FrameError::Replayed { sender: 2 });
    assert_eq!(one.open::<1>(&[KEY], &sealed), replayed);
    let farewell = Frame { sequence: 10, ..farewell };
    let sealed = two.seal(&farewell, &KEY).unwrap();
    assert_eq!(one.open(&[KEY], &sealed), Ok(Some(farewell)));
    assert_eq!(one.open::<1>(&[KEY], &sealed), replayed);
    // A hello is not answered with the sample from before it.
    let _ = two.open::<1>(&[KEY], &trust(1, (20, 30)).hello(0, &KEY).unwrap());
    assert_eq!(two.answer(&sampled(2, 9), 1_000, &KEY), None);
    let back = two.seal(&sampled(2, 11), &KEY).unwrap();
    assert_eq!(one.open(&[KEY], &back), Ok(Some(sampled(2, 11))));
    // A stranger cannot say farewell for it.
    let stranger = NetworkKey::new(1, Secret::new([8; 16]));
    let forged = two.seal(&Frame::<1>::farewell(2, 12, 120), &stranger).unwrap();
    assert_eq!(one.open::<1>(&[KEY], &forged), Err(FrameError::Tag { sender: 2 }));
}

#[test]
fn epochs_that_come_late_believe_no_answer_of_an_earlier_boot() {
    let [mut one, mut two] = pair(5, 8);
    let _ = two.seal(&sampled(2, 0), &KEY);
    let _ = two.open::<1>(&[KEY], &one.hello(0, &KEY).unwrap());
    let sync = two.answer(&sampled(2, 0), 3, &KEY).unwrap();
    let mut late = trust(1, (0, 0));
    late.extend((15, 19));
    assert_eq!(late.open::<1>(&[KEY], &sync), Err(FrameError::Replayed { sender: 2 }));
    assert!(late.hello(0, &KEY).is_some());
}

#[test]
fn an_agent_that_has_said_nothing_yet_must_speak_to_answer() {
    let [mut one, mut two] = pair(5, 8);
    assert!(!two.must_speak());
    let _ = two.open::<1>(&[KEY], &one.hello(0, &KEY).unwrap());
    assert!(two.must_speak());
    assert_eq!(two.answer(&sampled(2, 7), 3, &KEY), None);
    let _ = two.seal(&sampled(2, 7), &KEY);
    assert!(!two.must_speak());
    let sync = two.answer(&sampled(2, 7), 3, &KEY).unwrap();
    assert!(one.open::<1>(&[KEY], &sync).unwrap().is_some());
}
