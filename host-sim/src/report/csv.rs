//! CSV files: traces, broadcasts, training epochs.
//!
//! Cost: about 40 ns per number; 40,000 rows of three agents (16 columns) take about 30 ms.

use std::path::Path;

use crate::engine::traces::Traces;
use crate::files::output::OutputError;
use crate::files::table::write_table;

/// Writes traces: one line per row with the true state and each agent's estimate and error norm, in
/// the units of the state.
///
/// `names` are the names of the state's components, shape `[n]`. The columns are `time`, `NAME`
/// (true state), `agentI.NAMEhat` (estimate of agent I) and `agentI.error`. Names of states contain
/// neither dots nor spaces, so headers are unique; the unit distinguishes a state called `time`
/// from the time.
///
/// # Errors
/// If the file cannot be written, or the number of names differs from that of the components.
pub fn write_traces(path: &Path, traces: &Traces, names: &[String]) -> Result<(), OutputError> {
    let mut header = vec!["time [s]".to_owned()];
    header.extend(names.iter().map(|name| format!("{name} [state unit]")));
    for agent in 1..=traces.agents() {
        header.extend(names.iter().map(|name| format!("agent{agent}.{name}hat [state unit]")));
        header.push(format!("agent{agent}.error [state unit]"));
    }
    write_table(path, &header, 0..traces.rows(), |line, row| {
        line.double(traces.time()[row])?;
        // Nothing is known of them without a reference.
        let known = |x: f64| (!x.is_nan()).then_some(x);
        for &x in traces.truth(row) {
            line.optional(known(x))?;
        }
        for agent in 0..traces.agents() {
            for &x_hat in traces.estimate(row, agent) {
                line.single(x_hat)?;
            }
            line.optional(known(traces.error(row, agent)))?;
        }
        Ok(())
    })
}

/// Writes innovations: one line per row of the traces with `|e_3i|` of every agent, in the unit of its
/// outputs; empty where there was no measurement.
///
/// # Errors
/// If the file cannot be written.
pub fn write_innovations(path: &Path, traces: &Traces) -> Result<(), OutputError> {
    let mut header = vec!["time [s]".to_owned()];
    header.extend((1..=traces.agents()).map(|agent| format!("agent{agent} [output unit]")));
    write_table(path, &header, 0..traces.rows(), |line, row| {
        line.double(traces.time()[row])?;
        (0..traces.agents()).try_for_each(|agent| match traces.innovation(row, agent) {
            Some(innovation) => line.single(innovation),
            None => line.text(""),
        })
    })
}

/// Writes broadcasts agent by agent: number of the agent, sequence number (from 1), and time.
/// `events` are the steps at whose start each agent broadcast; a step is `step_size` \[s\] long.
///
/// # Errors
/// If the file cannot be written.
pub fn write_events(path: &Path, events: &[&[u64]], step_size: f64) -> Result<(), OutputError> {
    let numbered = events.iter().enumerate().flat_map(|(agent, ticks)| {
        ticks.iter().enumerate().map(move |(sequence, &tick)| (agent + 1, sequence + 1, tick))
    });
    write_table(
        path,
        &["agent", "sequence", "time [s]"],
        numbered,
        |row, (agent, sequence, tick)| {
            row.integer(agent as u64)?;
            row.integer(sequence as u64)?;
            row.double(tick as f64 * step_size)
        },
    )
}

/// One epoch of a training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpochRow {
    /// The agent, from 1.
    pub agent: usize,
    /// The learning cycle, from 1.
    pub cycle: usize,
    /// The epoch; 0 is the state before the first step.
    pub epoch: usize,
    /// Mean squared error on the training samples. \[squared state unit/s\]
    pub train_mse: f64,
    /// Mean squared error on the validation samples, if any. \[squared state unit/s\]
    pub validation_mse: Option<f64>,
    /// Mean squared error on the test samples, if any. \[squared state unit/s\]
    pub test_mse: Option<f64>,
    /// Damping of the Levenberg–Marquardt step.
    pub damping: f64,
    /// Norm of the gradient of the objective.
    pub gradient_norm: f64,
}

/// Writes the epochs of training runs.
///
/// # Errors
/// If the file cannot be written.
pub fn write_epochs(path: &Path, epochs: &[EpochRow]) -> Result<(), OutputError> {
    let header = [
        "agent",
        "cycle",
        "epoch",
        "train_mse [(state unit/s)^2]",
        "validation_mse [(state unit/s)^2]",
        "test_mse [(state unit/s)^2]",
        "damping",
        "gradient_norm",
    ];
    write_table(path, &header, epochs.iter(), |row, epoch| {
        row.integer(epoch.agent as u64)?;
        row.integer(epoch.cycle as u64)?;
        row.integer(epoch.epoch as u64)?;
        row.double(epoch.train_mse)?;
        row.optional(epoch.validation_mse)?;
        row.optional(epoch.test_mse)?;
        row.double(epoch.damping)?;
        row.double(epoch.gradient_norm)
    })
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn file(name: &str) -> PathBuf {
        std::env::temp_dir().join(format!("{}-{name}", std::process::id()))
    }

    /// Returns header and lines of a file, and removes it.
    fn read(path: &Path) -> (Vec<String>, Vec<Vec<String>>) {
        let mut reader = csv::Reader::from_path(path).unwrap();
        let words = |record: &csv::StringRecord| record.iter().map(str::to_owned).collect();
        let header = words(reader.headers().unwrap());
        let lines = reader.records().map(|record| words(&record.unwrap())).collect();
        std::fs::remove_file(path).unwrap();
        (header, lines)
    }

    #[test]
    fn traces_read_back_as_the_same_bits() {
        let mut traces = Traces::with_capacity(2, 2, 3);
        for row in 0..3 {
            let time = f64::from(row) * 0.001 * 7.0;
            let estimates = [[0.1_f32, 1.0 / 3.0], [f32::MIN_POSITIVE, -2.5e10]];
            traces.push(time, &[0.1 + 0.2, -1e-300], estimates.iter().map(|x| &x[..]));
        }
        let path = file("traces.csv");
        // A comma, a quote or a line break does not end a field.
        let names = ["angle".to_owned(), "a \"b\",\nc".to_owned()];
        write_traces(&path, &traces, &names).unwrap();
        let (header, lines) = read(&path);
        let names = [
            "angle",
            "a \"b\",\nc",
            "agent1.anglehat",
            "agent1.a \"b\",\nchat",
            "agent1.error",
            "agent2.anglehat",
            "agent2.a \"b\",\nchat",
            "agent2.error",
        ];
        assert_eq!(header[0], "time [s]");
        assert_eq!(header[1..], names.map(|name| format!("{name} [state unit]")));
        assert_eq!(lines.len(), 3);
        for (row, line) in lines.iter().enumerate() {
            let double = |column: usize| line[column].parse::<f64>().unwrap().to_bits();
            let single = |column: usize| line[column].parse::<f32>().unwrap().to_bits();
            assert_eq!(double(0), traces.time()[row].to_bits());
            for agent in 0..2 {
                assert_eq!(double(5 + 3 * agent), traces.error(row, agent).to_bits());
                for component in 0..2 {
                    assert_eq!(double(1 + component), traces.truth(row)[component].to_bits());
                    let estimate = traces.estimate(row, agent)[component];
                    assert_eq!(single(3 + 3 * agent + component), estimate.to_bits());
                }
            }
        }
    }

    #[test]
    fn broadcasts_are_numbered() {
        let path = file("events.csv");
        write_events(&path, &[&[0, 5], &[], &[7]], 0.001).unwrap();
        let (header, lines) = read(&path);
        assert_eq!(header, ["agent", "sequence", "time [s]"]);
        assert_eq!(lines, [["1", "1", "0.0"], ["1", "2", "0.005"], ["3", "1", "0.007"]]);
    }

    #[test]
    fn missing_values_of_an_epoch_are_empty() {
        let path = file("epochs.csv");
        let epoch = EpochRow {
            agent: 2,
            cycle: 1,
            epoch: 25,
            train_mse: 0.5,
            validation_mse: None,
            test_mse: Some(0.25),
            damping: 1e-8,
            gradient_norm: f64::NAN,
        };
        write_epochs(&path, &[epoch]).unwrap();
        let (header, lines) = read(&path);
        assert_eq!(header.len(), 8);
        assert_eq!(lines, [["2", "1", "25", "0.5", "", "0.25", "1e-8", "NaN"]]);
    }

    #[test]
    fn rejects_a_line_of_the_wrong_length() {
        let path = file("wrong.csv");
        let error = write_table(&path, &["one", "two"], 0..1, |row, number| row.integer(number));
        assert!(error.unwrap_err().to_string().contains("wrong.csv"));
        assert!(!path.exists());
    }
}
