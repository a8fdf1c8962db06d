//! A node's samples `(x_hat, d/dt x_hat)`, for training, written as they come.
//!
//! A state that a node tells holds `x_hat` *after* its step and the derivative *of* the step. So a
//! sample is made of two states in a row, and a recording of states needs every one of them. Where
//! the line is too slow for that, the node's own samples take their place: it keeps one in so many
//! steps, and is asked for them.
//!
//! Whatever a node tells, a file of samples comes out: what is not finite, or of another length, is
//! left out and counted, and after a reset the samples go on behind a gap in time, as a piece of
//! their own.
//!
//! Memory: one sample and the lines that have not been written, 64 KiB at most.

use agent_core::Tick;
use agent_core::service::State;
use serde::Serialize;

use super::record_file::{RecordError, RecordFile};

/// Shortest time between two pieces of a recording. \[s\]
const PIECE_GAP: f64 = 1.0;

/// What has been recorded, and what has been left out.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RecordCounts {
    /// Samples in the file that this recording wrote.
    pub samples: u64,
    /// Samples that were lost on the way.
    pub lost: u64,
    /// Samples that were left out since they were not finite, or not of the right length.
    pub bad: u64,
    /// Steps that the node did not take, and so told no sample of.
    pub not_stepped: u64,
    /// Resets of the node, after each of which a new piece begins.
    pub resets: u64,
}

/// Makes samples of what a node tells, and writes them.
#[derive(Debug)]
pub struct Recorder {
    file: RecordFile,
    counts: RecordCounts,
    /// Ticks between two samples.
    stride: u64,
    /// Ticks between the last sample of a piece and the first of the next.
    piece_gap: u64,
    /// `dt`. \[s\]
    step: f64,
    /// `x_hat` at the beginning of a tick.
    before: Option<(Tick, Vec<f32>)>,
    /// The newest tick of a state.
    newest: Option<Tick>,
    /// The piece that is being recorded.
    piece: Option<Piece>,
    /// The place in time of the last sample, in ticks since the first piece's zero.
    last_place: Option<u64>,
    outer_weights: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
struct Piece {
    first: Tick,
    /// Where the first sample is placed in time, in ticks.
    place: u64,
    last: Tick,
    /// Ticks since the last sample whose absence has been counted already.
    explained: u64,
}

impl Recorder {
    /// A recording into `file` of samples that come every `stride` ticks, of `step` \[s\] each.
    #[must_use]
    pub fn new(file: RecordFile, step: f64, stride: u64) -> Self {
        let stride = stride.max(1);
        let gap = (PIECE_GAP / step).ceil() as u64;
        let last_place = file.last_time().map(|time| (time / step).round() as u64);
        Self {
            file,
            counts: RecordCounts::default(),
            stride,
            piece_gap: gap.max(stride.saturating_mul(10)),
            step,
            before: None,
            newest: None,
            piece: None,
            last_place,
            outer_weights: Vec::new(),
        }
    }

    /// What has been recorded so far.
    #[must_use]
    pub fn counts(&self) -> RecordCounts {
        self.counts
    }

    /// Takes a state: a sample with the state before it, and its outer weights.
    ///
    /// # Errors
    /// See [`RecordError`], as with all methods here.
    pub fn state(&mut self, state: &State<Vec<f32>>) -> Result<(), RecordError> {
        self.look_for_reset(state.tick);
        self.weights(state);
        let before = self.before.replace((state.tick.saturating_add(1), state.estimate.clone()));
        let Some((_, estimate)) = before.filter(|(tick, _)| *tick == state.tick) else {
            return Ok(());
        };
        if state.derivative.is_empty() {
            self.counts.not_stepped += 1;
            self.explain();
            return Ok(());
        }
        self.sample(state.tick, &estimate, &state.derivative)
    }

    /// Takes of a state only what does not belong to a sample.
    pub fn accompany(&mut self, state: &State<Vec<f32>>) {
        self.look_for_reset(state.tick);
        self.weights(state);
    }

    fn weights(&mut self, state: &State<Vec<f32>>) {
        let weights = &state.outer_weights;
        if !weights.is_empty() && weights.iter().all(|weight| weight.is_finite()) {
            self.outer_weights.clone_from(weights);
        }
    }

    /// Ticks never go back but in a reset, whose greeting may have been lost.
    fn look_for_reset(&mut self, tick: Tick) {
        if self.newest.is_some_and(|newest| tick < newest) {
            self.reset();
        }
        self.newest = Some(tick);
    }

    /// The node has begun again: what comes now does not follow on what came before.
    pub fn reset(&mut self) {
        self.counts.resets += 1;
        (self.before, self.newest, self.piece) = (None, None, None);
    }

    /// Takes a sample; one that was taken before is left out.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn sample(
        &mut self,
        tick: Tick,
        estimate: &[f32],
        derivative: &[f32],
    ) -> Result<(), RecordError> {
        if self.piece.is_some_and(|piece| tick <= piece.last) {
            return Ok(());
        }
        let numbers = || estimate.iter().chain(derivative);
        let dimension = self.file.dimension().unwrap_or(estimate.len());
        let fits = dimension > 0 && [estimate.len(), derivative.len()] == [dimension; 2];
        let place = self.place(tick);
        let time = place as f64 * self.step;
        let in_time = self.file.last_time().is_none_or(|last| time > last);
        if !fits || !in_time || !numbers().all(|number| number.is_finite()) {
            self.counts.bad += 1;
            self.explain();
            return Ok(());
        }
        self.file.push(time, estimate, derivative, &self.outer_weights)?;
        self.counts.samples += 1;
        self.last_place = Some(place);
        let piece =
            self.piece.get_or_insert(Piece { first: tick, place, last: tick, explained: 0 });
        let missing = ((tick - piece.last) / self.stride).saturating_sub(1);
        let lost = missing.saturating_sub(piece.explained);
        self.counts.lost = self.counts.lost.saturating_add(lost);
        (piece.last, piece.explained) = (tick, 0);
        Ok(())
    }

    /// Where the sample of this tick is placed in time, in ticks.
    fn place(&self, tick: Tick) -> u64 {
        match (&self.piece, self.last_place) {
            (Some(piece), _) => piece.place.saturating_add(tick.saturating_sub(piece.first)),
            (None, Some(last)) => last.saturating_add(self.piece_gap),
            (None, None) => tick,
        }
    }

    /// That there is no sample of a tick has been counted.
    fn explain(&mut self) {
        if let Some(piece) = &mut self.piece {
            piece.explained = piece.explained.saturating_add(1);
        }
    }

    /// The tick from which on the next sample is wanted.
    #[must_use]
    pub fn next_tick(&self) -> Tick {
        self.piece.map_or(0, |piece| piece.last.saturating_add(1))
    }

    /// Writes what waits, if it has waited long enough.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn write_if_due(&mut self) -> Result<(), RecordError> {
        self.file.flush_if_due(&self.outer_weights)
    }

    /// Writes what is left.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn finish(mut self) -> Result<RecordCounts, RecordError> {
        self.file.finish(&self.outer_weights)?;
        Ok(self.counts)
    }
}

/// `dt` as the scenario has it, of the single precision that a node has: the number with the fewest
/// digits that a node would have rounded to the same. \[s\]
#[must_use]
pub fn step_size(on_node: f32) -> f64 {
    // The shortest decimal that is this f32 is what somebody wrote.
    on_node.to_string().parse().unwrap_or_else(|_| f64::from(on_node))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use agent_core::service::Outcome;

    use super::*;
    use crate::packages::{Recording, RecordingSource};

    fn state(tick: Tick) -> State<Vec<f32>> {
        let number = tick as f32;
        State {
            tick,
            outcome: Outcome::Stepped,
            estimate: vec![number, 0.5],
            derivative: vec![-number, 2.0],
            outer_weights: vec![number; 4],
        }
    }

    fn source() -> RecordingSource {
        RecordingSource { agent: Some(1), ..RecordingSource::default() }
    }

    fn recorder(path: &Path, append: bool) -> Recorder {
        let file = RecordFile::open(path, append, &source()).unwrap();
        Recorder::new(file, step_size(1e-3), 1)
    }

    /// When the samples in the file were taken, in steps.
    fn times(path: &Path) -> Vec<u64> {
        let text = std::fs::read_to_string(path).unwrap();
        let rows = text.lines().filter(|line| line.starts_with(|c: char| c.is_ascii_digit()));
        let time = |row: &str| row.split(',').next().unwrap().parse::<f64>().unwrap();
        rows.map(|row| (time(row) / 1e-3).round() as u64).collect()
    }

    #[test]
    fn states_in_a_row_become_samples_and_a_missing_one_a_gap() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let mut recorder = recorder(&path, false);
        for tick in [10, 11, 12, 13, 16, 17, 18, 19] {
            recorder.state(&state(tick)).unwrap();
        }
        let counts = recorder.finish().unwrap();
        // The estimate is that of the state before, the derivative that of the state.
        assert_eq!(times(&path), [11, 12, 13, 17, 18, 19]);
        // 14 and 15 are lost, and 16 has no state before it.
        assert_eq!(counts, RecordCounts { samples: 6, lost: 3, ..RecordCounts::default() });
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.samples.len(), read.gaps.clone()), (6, vec![3]));
        assert_eq!((read.samples.inputs()[0], read.samples.targets()[0]), (10.0, -11.0));
        assert_eq!((read.start, read.outer_weights), (0.011, Some(vec![19.0; 4])));
    }

    #[test]
    fn what_is_not_finite_or_of_another_length_is_skipped_and_the_rest_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let mut recorder = recorder(&path, false);
        for tick in 0..20 {
            let mut state = state(tick);
            match tick {
                5 => state.derivative[1] = f32::NAN,
                8 => state.estimate[0] = f32::INFINITY,
                11 => state.derivative.push(1.0),
                14 => state.derivative.clear(),
                17 => state.outer_weights[2] = f32::NAN,
                19 => state.outer_weights.clear(),
                _ => {}
            }
            recorder.state(&state).unwrap();
        }
        let counts = recorder.finish().unwrap();
        // 9 begins at the infinite estimate of 8.
        let expected = [1, 2, 3, 4, 6, 7, 8, 10, 12, 13, 15, 16, 17, 18, 19];
        assert_eq!(times(&path), expected);
        let counted = RecordCounts { samples: 15, bad: 3, not_stepped: 1, ..counts };
        assert_eq!((counts, counts.lost), (counted, 0));
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.samples.len(), read.outer_weights), (15, Some(vec![18.0; 4])));
    }

    #[test]
    fn a_reset_begins_a_new_piece_and_time_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let mut recorder = recorder(&path, false);
        let mut take = |ticks: std::ops::Range<Tick>| {
            ticks.for_each(|tick| recorder.state(&state(tick)).unwrap());
        };
        take(500..506);
        // The greeting after this reset has been lost.
        take(0..5);
        recorder.reset();
        (0..3).for_each(|tick| recorder.state(&state(tick)).unwrap());
        let counts = recorder.finish().unwrap();
        assert_eq!((counts.samples, counts.resets, counts.lost), (11, 2, 0));
        assert_eq!(times(&path), [501, 502, 503, 504, 505, 1505, 1506, 1507, 1508, 2508, 2509]);
        assert_eq!(Recording::load(&path, 2, 2).unwrap().gaps, [5, 9]);
    }

    #[test]
    fn a_recording_is_added_to_and_never_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let record = |append, ticks: std::ops::Range<Tick>| {
            let mut recorder = recorder(&path, append);
            ticks.for_each(|tick| recorder.state(&state(tick)).unwrap());
            recorder.finish().unwrap();
        };
        record(false, 0..4);
        let refused = RecordFile::open(&path, false, &source()).unwrap_err().to_string();
        assert!(refused.contains("--append"), "{refused}");
        // A line that was cut by a loss of power.
        let mut text = std::fs::read_to_string(&path).unwrap();
        text += "0.004,1.0,0.";
        std::fs::write(&path, text).unwrap();
        record(true, 7..10);
        assert_eq!(times(&path), [1, 2, 3, 1003, 1004]);
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.gaps, read.outer_weights), (vec![3], Some(vec![9.0; 4])));
        let other = RecordingSource { agent: Some(2), ..source() };
        let refused = RecordFile::open(&path, true, &other).unwrap_err().to_string();
        assert!(refused.contains("of agent 1, and this is agent 2"), "{refused}");
    }

    #[test]
    fn a_recording_goes_behind_a_link_and_never_onto_a_disk() {
        let folder = tempfile::tempdir().unwrap();
        let (link, path) = (folder.path().join("link.csv"), folder.path().join("behind.csv"));
        std::os::unix::fs::symlink("behind.csv", &link).unwrap();
        drop(recorder(&link, false));
        assert!(!path.exists() && link.symlink_metadata().unwrap().is_symlink());
        let mut recorder = recorder(&link, false);
        (0..4).for_each(|tick| recorder.state(&state(tick)).unwrap());
        recorder.finish().unwrap();
        assert_eq!(times(&path), [1, 2, 3]);
        assert!(link.symlink_metadata().unwrap().is_symlink());

        // Whatever disk there is, if there is one.
        let disks = std::fs::read_dir("/dev").unwrap().filter_map(Result::ok);
        let is_disk = |path: &std::path::PathBuf| {
            use std::os::unix::fs::FileTypeExt;
            std::fs::metadata(path).is_ok_and(|found| found.file_type().is_block_device())
        };
        if let Some(disk) = disks.map(|entry| entry.path()).find(is_disk) {
            let refused = RecordFile::open(&disk, false, &source()).unwrap_err().to_string();
            assert!(refused.ends_with(": is a disk; choose a file name"), "{refused}");
        }
    }

    #[test]
    fn a_full_disk_is_told() {
        let full = Path::new("/dev/full");
        if !full.exists() {
            return;
        }
        let mut recorder = recorder(full, false);
        (0..9).for_each(|tick| recorder.state(&state(tick)).unwrap());
        let error = recorder.finish().unwrap_err().to_string();
        assert!(error.starts_with("/dev/full: "), "{error}");
    }

    #[test]
    fn nothing_is_left_without_samples() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let counts = recorder(&path, false).finish().unwrap();
        assert_eq!(counts, RecordCounts::default());
        assert!(!path.exists());
    }
}
