//! MCAP recordings of runs, for Foxglove and PlotJuggler.
//!
//! | topic | messages | fields |
//! | --- | --- | --- |
//! | `plant` | one for each row of the traces | the state by component \[state unit\] |
//! | `agentI` | the same | `estimate` by component, `error` \[state unit\], `innovation` \[output unit\] |
//! | `agentI/broadcasts` | one for each broadcast | `sequence`, from 1 |
//!
//! Messages are JSON with a JSON schema, which both programs read. Times are those of the run, from 0. Cost:
//! about 100 bytes for each agent and row; nothing is compressed.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{McapResult, WriteOptions, Writer};
use serde_json::{Map, Value, json};

use crate::engine::RunResult;
use crate::files::output::{FileKind, OutputError, write_result};
use crate::scenario::Scenario;

/// The kind of these files.
pub const KIND: FileKind =
    FileKind { name: "an MCAP recording", recognises: |bytes| bytes.starts_with(mcap::MAGIC) };

/// Writes the traces and broadcasts that a run has recorded.
///
/// # Errors
/// If the file cannot be written.
pub fn write_mcap(path: &Path, scenario: &Scenario, run: &RunResult) -> Result<(), OutputError> {
    write_result(path, KIND, |file| write(file, scenario, run).map_err(io::Error::other))
}

fn write(file: &mut dyn Write, scenario: &Scenario, run: &RunResult) -> McapResult<()> {
    let options = WriteOptions::new().compression(None).disable_seeking(true);
    let library = concat!("host-sim ", env!("CARGO_PKG_VERSION"));
    let mut recording = Recording(options.library(library).create(NoSeek::new(file))?);
    let names = scenario.plant.state_names();
    let by_component = |values: &[f64]| -> Value {
        let fields = names.iter().zip(values).map(|(name, &value)| (name.clone(), json!(value)));
        Value::Object(fields.collect::<Map<_, _>>())
    };
    let state = object(names.iter().map(|name| (name.as_str(), number())));
    let traces = &run.traces;
    let plant = recording.channel("plant", &state)?;
    let estimate =
        object([("estimate", state.clone()), ("error", number()), ("innovation", number())]);
    let event = object([("sequence", json!({"type": "integer"}))]);
    let agents = 1..=run.agents.len();
    let estimates: Vec<u16> = agents
        .clone()
        .map(|agent| recording.channel(&format!("agent{agent}"), &estimate))
        .collect::<McapResult<_>>()?;
    let broadcasts: Vec<u16> = agents
        .map(|agent| recording.channel(&format!("agent{agent}/broadcasts"), &event))
        .collect::<McapResult<_>>()?;
    // Messages are in the order of time, as players want them.
    let mut next = vec![0; run.agents.len()];
    for row in 0..=traces.rows() {
        let until = traces.time().get(row).copied().unwrap_or(f64::INFINITY);
        for (agent, next) in next.iter_mut().enumerate() {
            while let Some(&tick) = run.agents[agent].events.get(*next)
                && scenario.time.at(tick) <= until
            {
                *next += 1;
                let message = json!({"sequence": *next});
                recording.message(broadcasts[agent], *next, scenario.time.at(tick), &message)?;
            }
        }
        if row == traces.rows() {
            break;
        }
        recording.message(plant, row, until, &by_component(traces.truth(row)))?;
        for (agent, &channel) in estimates.iter().enumerate() {
            let values: Vec<f64> =
                traces.estimate(row, agent).iter().map(|&value| f64::from(value)).collect();
            let message = json!({
                "estimate": by_component(&values),
                "error": traces.error(row, agent),
                "innovation": traces.innovation(row, agent),
            });
            recording.message(channel, row, until, &message)?;
        }
    }
    recording.0.finish().map(drop)
}

/// A recording in progress.
struct Recording<'f>(Writer<NoSeek<&'f mut dyn Write>>);

impl Recording<'_> {
    fn channel(&mut self, topic: &str, schema: &Value) -> McapResult<u16> {
        let schema = self.0.add_schema(topic, "jsonschema", schema.to_string().as_bytes())?;
        self.0.add_channel(schema, topic, "json", &BTreeMap::new())
    }

    fn message(
        &mut self,
        channel_id: u16,
        sequence: usize,
        time: f64,
        message: &Value,
    ) -> McapResult<()> {
        let time = (time * 1e9).round() as u64;
        // Wraps around after 4,294,967,295 messages, as the format does.
        let sequence = sequence as u32;
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        self.0.write_to_known_channel(&header, message.to_string().as_bytes())
    }
}

fn number() -> Value {
    json!({"type": "number"})
}

fn object<'n>(fields: impl IntoIterator<Item = (&'n str, Value)>) -> Value {
    let properties: Map<String, Value> =
        fields.into_iter().map(|(name, schema)| (name.to_owned(), schema)).collect();
    json!({"type": "object", "properties": properties})
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::engine::{RunOptions, Silent, run};
    use crate::scenario::PAPER;

    #[test]
    fn a_reader_finds_every_row_and_broadcast_in_order() {
        let mut scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        scenario.learning.clear();
        scenario.time.duration = 0.05;
        let options = RunOptions { seed: 0, learning: true, bounds: false };
        let result = run(&scenario, options, &Silent).unwrap();
        let path = std::env::temp_dir().join(format!("{}-run.mcap", std::process::id()));
        write_mcap(&path, &scenario, &result).unwrap();
        let bytes = fs::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        assert!((KIND.recognises)(&bytes));
        let messages: Vec<_> =
            mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
        assert!(messages.is_sorted_by_key(|message| message.log_time));
        let of = |topic: &str| {
            messages.iter().filter(|message| message.channel.topic == topic).collect::<Vec<_>>()
        };
        let json = |bytes: &[u8]| serde_json::from_slice::<Value>(bytes).unwrap();
        let rows = of("agent2");
        assert_eq!(rows.len(), result.traces.rows());
        for (row, message) in rows.iter().enumerate() {
            let message = json(&message.data);
            // The reader of JSON may be off by the last bit.
            let is_close = |found: &Value, expected: f64| {
                (found.as_f64().unwrap() - expected).abs() <= 1e-15 * expected.abs()
            };
            assert!(is_close(&message["error"], result.traces.error(row, 1)));
            let estimate = f64::from(result.traces.estimate(row, 1)[1]);
            assert!(is_close(&message["estimate"]["y"], estimate));
            // The last row has no step.
            assert_eq!(message["innovation"].is_null(), row + 1 == rows.len());
        }
        assert_eq!(json(&of("plant")[0].data)["z"], 8.0);
        let events: Vec<u64> =
            of("agent3/broadcasts").iter().map(|message| message.log_time / 1_000_000).collect();
        assert_eq!(events, result.agents[2].events);
    }
}
