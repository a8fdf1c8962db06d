//! Records a node's samples `(x_hat, d/dt x_hat)` for training.
//!
//! A reported state has `x_hat` *after* its step and the derivative *of* the step. So a sample is
//! combined from two consecutive states, which requires the state of every step. If the line is too
//! slow for that, the node's own samples, kept at a fixed stride, are requested instead.
//!
//! Samples that are not finite or have the wrong length are skipped and counted. After a reset, the
//! recording continues as a new segment after a gap in time.
//!
//! Memory: one sample and the unwritten lines, at most 64 KiB.

use agent_core::Tick;
use agent_core::service::State;
use serde::Serialize;

use super::record_file::{RecordError, RecordFile};

/// Shortest gap between two segments of a recording. \[s\]
const PIECE_GAP: f64 = 1.0;

/// Counts of recorded and skipped samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RecordCounts {
    /// Samples written by this recording.
    pub samples: u64,
    /// Samples lost in transit.
    pub lost: u64,
    /// Samples skipped because they were not finite or had the wrong length.
    pub bad: u64,
    /// Steps that the node did not take, which have no sample.
    pub not_stepped: u64,
    /// Resets of the node, each of which starts a new segment.
    pub resets: u64,
}

/// Converts a node's messages to samples and writes them.
#[derive(Debug)]
pub struct Recorder {
    file: RecordFile,
    counts: RecordCounts,
    /// Ticks between two samples.
    stride: u64,
    /// Ticks between the last sample of a segment and the first of the next.
    piece_gap: u64,
    /// `dt`. \[s\]
    step: f64,
    /// `x_hat` at the start of a tick.
    before: Option<(Tick, Vec<f32>)>,
    /// Tick of the newest state.
    newest: Option<Tick>,
    /// The current segment.
    piece: Option<Piece>,
    /// Time of the last sample, in ticks since tick 0 of the first segment.
    last_place: Option<u64>,
    outer_weights: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
struct Piece {
    first: Tick,
    /// Position of the first sample in time. \[ticks\]
    place: u64,
    last: Tick,
    /// Ticks since the last sample whose missing samples have already been counted.
    accounted: u64,
}

impl Recorder {
    /// Creates a recorder of samples every `stride` ticks, of `step` \[s\] each, into `file`.
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

    /// Returns the counts so far.
    #[must_use]
    pub fn counts(&self) -> RecordCounts {
        self.counts
    }

    /// Records a state, which forms a sample with the previous state, and its outer weights.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn state(&mut self, state: &State<Vec<f32>>) -> Result<(), RecordError> {
        self.detect_reset(state.tick);
        self.weights(state);
        let before = self.before.replace((state.tick.saturating_add(1), state.estimate.clone()));
        let Some((_, estimate)) = before.filter(|(tick, _)| *tick == state.tick) else {
            return Ok(());
        };
        if state.derivative.is_empty() {
            self.counts.not_stepped += 1;
            self.account();
            return Ok(());
        }
        self.sample(state.tick, &estimate, &state.derivative)
    }

    /// Takes only outer weights and resets from a state, not a sample.
    pub fn observe(&mut self, state: &State<Vec<f32>>) {
        self.detect_reset(state.tick);
        self.weights(state);
    }

    fn weights(&mut self, state: &State<Vec<f32>>) {
        let weights = &state.outer_weights;
        if !weights.is_empty() && weights.iter().all(|weight| weight.is_finite()) {
            self.outer_weights.clone_from(weights);
        }
    }

    /// Detects a reset whose greeting was lost: only then do ticks decrease.
    fn detect_reset(&mut self, tick: Tick) {
        if self.newest.is_some_and(|newest| tick < newest) {
            self.reset();
        }
        self.newest = Some(tick);
    }

    /// Starts a new segment after a reset of the node.
    pub fn reset(&mut self) {
        self.counts.resets += 1;
        (self.before, self.newest, self.piece) = (None, None, None);
    }

    /// Records a sample, unless it is already recorded.
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
            self.account();
            return Ok(());
        }
        self.file.push(time, estimate, derivative, &self.outer_weights)?;
        self.counts.samples += 1;
        self.last_place = Some(place);
        let piece =
            self.piece.get_or_insert(Piece { first: tick, place, last: tick, accounted: 0 });
        let missing = ((tick - piece.last) / self.stride).saturating_sub(1);
        let lost = missing.saturating_sub(piece.accounted);
        self.counts.lost = self.counts.lost.saturating_add(lost);
        (piece.last, piece.accounted) = (tick, 0);
        Ok(())
    }

    /// Returns the position of this tick's sample in time. \[ticks\]
    fn place(&self, tick: Tick) -> u64 {
        match (&self.piece, self.last_place) {
            (Some(piece), _) => piece.place.saturating_add(tick.saturating_sub(piece.first)),
            (None, Some(last)) => last.saturating_add(self.piece_gap),
            (None, None) => tick,
        }
    }

    /// Notes that a missing sample has been counted.
    fn account(&mut self) {
        if let Some(piece) = &mut self.piece {
            piece.accounted = piece.accounted.saturating_add(1);
        }
    }

    /// Returns the earliest tick of the next sample.
    #[must_use]
    pub fn next_tick(&self) -> Tick {
        self.piece.map_or(0, |piece| piece.last.saturating_add(1))
    }

    /// Writes buffered lines if they are due.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn write_if_due(&mut self) -> Result<(), RecordError> {
        self.file.flush_if_due(&self.outer_weights)
    }

    /// Writes the remaining lines and returns the counts.
    ///
    /// # Errors
    /// See [`RecordError`].
    pub fn finish(mut self) -> Result<RecordCounts, RecordError> {
        self.file.finish(&self.outer_weights)?;
        Ok(self.counts)
    }
}

/// Recovers the scenario's `dt` from a node's single precision: the number with the fewest digits
/// that rounds to the same. \[s\]
#[must_use]
pub fn step_size(on_node: f32) -> f64 {
    // The shortest decimal that parses to this f32 is most likely the one in the scenario.
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

    /// Returns the times of the samples in the file, in steps.
    fn times(path: &Path) -> Vec<u64> {
        let text = std::fs::read_to_string(path).unwrap();
        let rows = text.lines().filter(|line| line.starts_with(|c: char| c.is_ascii_digit()));
        let time = |row: &str| row.split(',').next().unwrap().parse::<f64>().unwrap();
        rows.map(|row| (time(row) / 1e-3).round() as u64).collect()
    }

    #[test]
    fn consecutive_states_form_samples_and_a_missing_state_a_gap() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let mut recorder = recorder(&path, false);
        for tick in [10, 11, 12, 13, 16, 17, 18, 19] {
            recorder.state(&state(tick)).unwrap();
        }
        let counts = recorder.finish().unwrap();
        // A sample has the previous state's estimate and this state's derivative.
        assert_eq!(times(&path), [11, 12, 13, 17, 18, 19]);
        // 14 and 15 are lost, and 16 has no previous state.
        assert_eq!(counts, RecordCounts { samples: 6, lost: 3, ..RecordCounts::default() });
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.samples.len(), read.gaps.clone()), (6, vec![3]));
        assert_eq!((read.samples.inputs()[0], read.samples.targets()[0]), (10.0, -11.0));
        assert_eq!((read.start, read.outer_weights), (0.011, Some(vec![19.0; 4])));
    }

    #[test]
    fn invalid_samples_are_skipped_and_the_rest_kept() {
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
        // 9 starts at the infinite estimate of 8.
        let expected = [1, 2, 3, 4, 6, 7, 8, 10, 12, 13, 15, 16, 17, 18, 19];
        assert_eq!(times(&path), expected);
        let counted = RecordCounts { samples: 15, bad: 3, not_stepped: 1, ..counts };
        assert_eq!((counts, counts.lost), (counted, 0));
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.samples.len(), read.outer_weights), (15, Some(vec![18.0; 4])));
    }

    #[test]
    fn a_reset_starts_a_new_segment_later_in_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let mut recorder = recorder(&path, false);
        let mut take = |ticks: std::ops::Range<Tick>| {
            ticks.for_each(|tick| recorder.state(&state(tick)).unwrap());
        };
        take(500..506);
        // The greeting after this reset is lost.
        take(0..5);
        recorder.reset();
        (0..3).for_each(|tick| recorder.state(&state(tick)).unwrap());
        let counts = recorder.finish().unwrap();
        assert_eq!((counts.samples, counts.resets, counts.lost), (11, 2, 0));
        assert_eq!(times(&path), [501, 502, 503, 504, 505, 1505, 1506, 1507, 1508, 2508, 2509]);
        assert_eq!(Recording::load(&path, 2, 2).unwrap().gaps, [5, 9]);
    }

    #[test]
    fn a_recording_is_appended_to_and_never_replaced() {
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
        // A line cut off by a power failure.
        let mut text = std::fs::read_to_string(&path).unwrap();
        text += "0.004,1.0,0.";
        std::fs::write(&path, text).unwrap();
        record(true, 7..10);
        assert_eq!(times(&path), [1, 2, 3, 1003, 1004]);
        let read = Recording::load(&path, 2, 2).unwrap();
        assert_eq!((read.gaps, read.outer_weights), (vec![3], Some(vec![9.0; 4])));
        let other = RecordingSource { agent: Some(2), ..source() };
        let refused = RecordFile::open(&path, true, &other).unwrap_err().to_string();
        assert!(refused.contains("of agent 1, not of agent 2"), "{refused}");
    }

    #[test]
    fn a_recording_follows_links_and_refuses_disks() {
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

        // Any disk, if there is one.
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
    fn a_full_disk_is_reported() {
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
    fn without_samples_the_file_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        let counts = recorder(&path, false).finish().unwrap();
        assert_eq!(counts, RecordCounts::default());
        assert!(!path.exists());
    }
}
