//! `[plant]` with `model = "recording"`: reads the table of an experiment.

use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::state_names::{check_inputs, states};
use crate::files::input::{Limited, is_too_large};
use crate::files::text;
use crate::number::counted;
use crate::plant::{Between, Recorded};
use crate::scenario::error::{ScenarioError, closest};
use crate::scenario::reader::{Table, Value};

/// Size limit of the file. \[bytes\]
const BYTES_MAX: u64 = 1 << 30;

/// The keys of the table.
const KEYS: [&str; 7] = ["model", "file", "time", "states", "reference", "inputs", "between"];

const NAME_A_COLUMN: &str = "name a column of the recording in quotes";

/// Reads the recording that the table names.
pub(super) fn recording(table: &Table<'_>) -> Result<Recorded, ScenarioError> {
    table.only(&KEYS)?;
    let states = states(table)?;
    let file = table.require("file", "\"experiment.csv\"")?;
    let (mut recorded, lines) = read(&file, &place(table, file.text()?))?;
    recorded.states = states;
    take_time(&mut recorded, &lines, table, &file)?;
    if let Some(value) = table.get("reference", "[\"x\", \"v\"]") {
        recorded.reference = columns(&recorded, &value, recorded.states.len(), "state")?;
        let hint = "remove that line, or leave the reference out";
        check_complete(&recorded, &recorded.reference, &lines, &value, hint)?;
    }
    if let Some(value) = table.get("inputs", "[\"valve\"]") {
        let count = value.list(NAME_A_COLUMN)?.len();
        check_inputs(&value, count, recorded.states.len())?;
        recorded.inputs = columns(&recorded, &value, count, "input")?;
        check_known(&recorded, &value)?;
        let hint = "fill in the cell, or remove that line";
        check_complete(&recorded, &recorded.inputs, &lines, &value, hint)?;
    }
    if let Some(value) = table.get("between", "\"hold\"") {
        recorded.between = value.choice(&[
            ("hold", Between::Hold),
            ("linear", Between::Linear),
            ("nothing", Between::Nothing),
        ])?;
    }
    Ok(recorded)
}

/// Checks that the inputs are different columns, and not the state that agents are to estimate.
fn check_known(recorded: &Recorded, value: &Value<'_>) -> Result<(), ScenarioError> {
    for (index, (column, value)) in
        recorded.inputs.iter().zip(value.list(NAME_A_COLUMN)?).enumerate()
    {
        let name = &recorded.names[*column];
        if recorded.inputs[..index].contains(column) {
            let problem = format!("the column `{name}` is listed twice");
            return Err(value.error(problem, "list each column once"));
        }
        if recorded.reference.contains(column) {
            let problem = format!("the column `{name}` is the reference of a state");
            let hint = "remove it: agents know their inputs, so they would know the state";
            return Err(value.error(problem, hint));
        }
    }
    Ok(())
}

/// Checks that each of the columns that `value` names has a number in every row.
fn check_complete(
    recorded: &Recorded,
    columns: &[usize],
    lines: &[u64],
    value: &Value<'_>,
    hint: &str,
) -> Result<(), ScenarioError> {
    for (&column, value) in columns.iter().zip(value.list(NAME_A_COLUMN)?) {
        let cells = &recorded.columns[column];
        if let Some(row) = cells.iter().position(|&x| !(x as f32).is_finite()) {
            if cells[row].is_finite() {
                let problem = format!("line {} of the file has {:e} there", lines[row], cells[row]);
                let hint = "use a larger unit: agents calculate in single precision";
                return Err(value.error(problem, hint));
            }
            let problem = format!("line {} of the file has no number there", lines[row]);
            return Err(value.error(problem, hint));
        }
    }
    Ok(())
}

/// Returns the columns that `value` names, of which there must be `count`, one for each `owner`.
pub(super) fn columns(
    recorded: &Recorded,
    value: &Value<'_>,
    count: usize,
    owner: &str,
) -> Result<Vec<usize>, ScenarioError> {
    let list = value.list(NAME_A_COLUMN)?;
    if list.len() != count {
        let columns = |count: usize| counted(count as u64, "column", "columns");
        let problem =
            format!("names {}, expected {count}, one for each {owner}", columns(list.len()));
        return Err(value.error(problem, format!("name {} of the recording", columns(count))));
    }
    list.iter().map(|name| column(recorded, name)).collect()
}

fn column(recorded: &Recorded, value: &Value<'_>) -> Result<usize, ScenarioError> {
    let name = value.text()?;
    recorded.column(name).ok_or_else(|| {
        let known = recorded.names.iter().map(String::as_str);
        let hint = match closest(name, known) {
            Some(close) => format!("did you mean {close}?"),
            None => format!("columns of the recording: {}", recorded.names.join(", ")),
        };
        value.error(format_args!("the recording has no column `{name}`"), hint)
    })
}

/// Returns the path of a file that is named relative to the scenario's folder.
fn place(table: &Table<'_>, name: &str) -> PathBuf {
    let folder = Path::new(table.file()).parent().unwrap_or(Path::new(""));
    folder.join(name)
}

/// Reads the file at `path`; also returns the line of each row.
fn read(value: &Value<'_>, path: &Path) -> Result<(Recorded, Vec<u64>), ScenarioError> {
    let shown = path.display();
    let unreadable = |error: &io::Error| {
        if is_too_large(error) {
            let hint = "record less, or keep only the columns that are used";
            return value.error(format_args!("{shown} is too large: {error}"), hint);
        }
        value.error(
            format_args!("{shown} cannot be read: {error}"),
            "name a CSV file; the path is relative to the scenario's folder",
        )
    };
    let (head, content) = text::open(path).map_err(|error| unreadable(&error))?;
    text::check_text(&head)
        .map_err(|(problem, hint)| value.error(format_args!("{shown} {problem}"), hint))?;
    let mut bytes = Vec::new();
    Limited::new(content, BYTES_MAX).read_to_end(&mut bytes).map_err(|error| unreadable(&error))?;
    let is_header = |line: &&[u8]| !line.starts_with(b"#") && !line.trim_ascii().is_empty();
    let first = bytes.split(|&byte| byte == b'\n').find(is_header);
    let delimiter = delimiter(first.unwrap_or_default());
    let mut reader = csv::ReaderBuilder::new()
        .delimiter(delimiter)
        .comment(Some(b'#'))
        .trim(csv::Trim::All)
        .from_reader(bytes.as_slice());
    let wrong = |problem: String, hint: &str| value.error(format!("{shown}: {problem}"), hint);
    let table = "write a header line with the columns' names, then one row for each time";
    let names = reader.headers().map_err(|error| wrong(error.to_string(), table))?;
    let names: Vec<String> = names.iter().map(str::to_owned).collect();
    if names.is_empty() {
        return Err(wrong("has no columns".to_owned(), table));
    }
    let is_number = |name: &String| name.parse::<f64>().is_ok_and(f64::is_finite);
    if names.iter().any(is_number) {
        return Err(wrong("the first line has numbers instead of names".to_owned(), table));
    }
    if let Some(name) = names
        .iter()
        .enumerate()
        .find_map(|(place, name)| names[..place].contains(name).then_some(name))
    {
        return Err(wrong(format!("two columns are called `{name}`"), "give each its own name"));
    }
    let (mut columns, mut lines) = (vec![Vec::new(); names.len()], Vec::new());
    for record in reader.records() {
        let record = record.map_err(|error| wrong(error.to_string(), table))?;
        let line = record.position().map_or(0, csv::Position::line);
        for ((cell, column), name) in record.iter().zip(&mut columns).zip(&names) {
            let number = match cell {
                "" => f64::NAN,
                cell => cell.parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| {
                    let problem =
                        format!("line {line}, column `{name}`: `{cell}` is not a finite number");
                    wrong(problem, "write a number, or leave the cell empty")
                })?,
            };
            column.push(number);
        }
        lines.push(line);
    }
    let empty = Between::default();
    let (states, time) = (Vec::new(), Vec::new());
    let (reference, inputs) = (Vec::new(), Vec::new());
    Ok((Recorded { states, time, names, columns, reference, inputs, between: empty }, lines))
}

/// Returns what separates the columns of this header.
fn delimiter(header: &[u8]) -> u8 {
    let count = |delimiter: u8| header.iter().filter(|&&byte| byte == delimiter).count();
    [b',', b';', b'\t', b'|'].into_iter().max_by_key(|&d| (count(d), d == b',')).unwrap_or(b',')
}

/// Takes the column of the time, which is counted from its first row.
fn take_time(
    recorded: &mut Recorded,
    lines: &[u64],
    table: &Table<'_>,
    file: &Value<'_>,
) -> Result<(), ScenarioError> {
    let column = match table.get("time", "\"t\"") {
        Some(value) => column(recorded, &value)?,
        None => ["time", "t", "time [s]"]
            .iter()
            .find_map(|name| recorded.column(name))
            .ok_or_else(|| {
                let hint = "name the column with the time in seconds, such as time = \"t\"";
                file.error("the recording has no column `time` or `t`", hint)
            })?,
    };
    let name = &recorded.names[column];
    let units = ["ms", "us", "ns", "min", "h"];
    let unit =
        name.rsplit(['[', '(', ' ', '_']).next().unwrap_or_default().trim_end_matches([']', ')']);
    if name.len() > unit.len() && units.contains(&unit) {
        let problem = format!("the time of the recording, `{name}`, is in {unit}");
        return Err(
            file.error(problem, "convert it to seconds, and name the column `time [s]` or `t`")
        );
    }
    let time = &recorded.columns[column];
    if time.len() < 2 {
        let shown = place(table, file.text()?);
        let found = match lines {
            [] => "has no rows after its header".to_owned(),
            [line, ..] => format!("has only one row of numbers, in line {line}"),
        };
        let problem = format!("{}: the recording {found}", shown.display());
        return Err(file.error(problem, "give at least two rows, one for each time"));
    }
    if let Some(row) = time.iter().position(|time| !time.is_finite()) {
        let problem = format!("line {} of the file has no time", lines[row]);
        return Err(file.error(problem, "write the time of every row, in seconds"));
    }
    if let Some(row) = time.windows(2).position(|pair| pair[0] >= pair[1]) {
        let (before, after, line) = (time[row], time[row + 1], lines[row + 1]);
        return Err(file.error(
            format_args!(
                "time does not increase in line {line} of the file: {after} after {before}"
            ),
            "sort the rows by time, and keep one row for each time",
        ));
    }
    let start = time[0];
    recorded.time = time.iter().map(|time| time - start).collect();
    Ok(())
}
