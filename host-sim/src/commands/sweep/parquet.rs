//! `results.parquet`: the rows of `results.csv` for pandas, Polars and DuckDB, with types.
//!
//! Varied keys are numbers if all their values are, and strings otherwise; seeds and counts are integers.
//! What a run without a result did not measure is null. The same table gives the same bytes.

use std::path::Path;
use std::sync::Arc;

use parquet::basic::{ConvertedType, LogicalType, Repetition, Type as Physical};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::types::Type;

use super::results::keys_of;
use crate::commands::{CommandError, ErrorCode};
use crate::files::output::{FileKind, write_result};
use crate::files::text;

/// Name of the file.
pub(super) const NAME: &str = "results.parquet";

/// A column, with what its cells are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    Integer,
    /// Never negative.
    Count,
    Number,
    Flag,
    Text,
}

/// Writes `results.parquet` in `folder` from the table `results`.
pub(super) fn write(folder: &Path, results: &Path) -> Result<(), CommandError> {
    let failed = |problem: String| {
        CommandError::new(ErrorCode::OutputFailed, format!("{}: {problem}", results.display()))
    };
    let (_, content) =
        text::open(results).map_err(|error| failed(format!("cannot read: {error}")))?;
    let mut reader = csv::Reader::from_reader(content);
    let unreadable = |error: csv::Error| failed(format!("cannot read: {error}"));
    let names: Vec<String> =
        reader.headers().map_err(unreadable)?.iter().map(str::to_owned).collect();
    let mut columns: Vec<Vec<String>> = vec![Vec::new(); names.len()];
    for record in reader.records() {
        let record = record.map_err(unreadable)?;
        columns.iter_mut().zip(&record).for_each(|(column, cell)| column.push(cell.to_owned()));
    }
    let bytes = encoded(&names, &columns)
        .map_err(|error| failed(format!("cannot be written as Parquet: {error}")))?;
    Ok(write_result(&folder.join(NAME), FileKind::PARQUET, |file| file.write_all(&bytes))?)
}

/// Returns the file with these columns.
fn encoded(names: &[String], columns: &[Vec<String>]) -> Result<Vec<u8>, ParquetError> {
    let keys = keys_of(names).map_or(0, |(keys, _)| keys);
    let kinds: Vec<Kind> = names
        .iter()
        .zip(columns)
        .enumerate()
        .map(|(place, (name, cells))| match name.as_str() {
            _ if place < keys => kind_of_key(cells),
            "rmse" | "max_error" | "innovation_rms" => Kind::Number,
            "diverged" => Kind::Flag,
            _ => Kind::Count,
        })
        .collect();
    let fields = names.iter().zip(&kinds).map(|(name, kind)| field(name, *kind).map(Arc::new));
    let fields = fields.collect::<Result<Vec<_>, _>>()?;
    let schema = Type::group_type_builder("results").with_fields(fields).build()?;
    let properties = Arc::new(WriterProperties::builder().build());
    let mut writer = SerializedFileWriter::new(Vec::new(), Arc::new(schema), properties)?;
    let mut group = writer.next_row_group()?;
    let mut rest = kinds.iter().zip(columns);
    while let Some(mut column) = group.next_column()? {
        if let Some((kind, cells)) = rest.next() {
            fill(&mut column, *kind, cells)?;
        }
        column.close()?;
    }
    group.close()?;
    writer.into_inner()
}

fn kind_of_key(cells: &[String]) -> Kind {
    let are = |is: fn(&str) -> bool| cells.iter().all(|cell| is(cell));
    if are(|cell| cell.parse::<i64>().is_ok()) {
        Kind::Integer
    } else if are(|cell| cell.parse::<f64>().is_ok()) {
        Kind::Number
    } else if are(|cell| cell.parse::<bool>().is_ok()) {
        Kind::Flag
    } else {
        Kind::Text
    }
}

/// Returns the description of a column whose cells may be null.
fn field(name: &str, kind: Kind) -> Result<Type, ParquetError> {
    let physical = match kind {
        Kind::Integer | Kind::Count => Physical::INT64,
        Kind::Number => Physical::DOUBLE,
        Kind::Flag => Physical::BOOLEAN,
        Kind::Text => Physical::BYTE_ARRAY,
    };
    let field = Type::primitive_type_builder(name, physical).with_repetition(Repetition::OPTIONAL);
    match kind {
        Kind::Text => field
            .with_converted_type(ConvertedType::UTF8)
            .with_logical_type(Some(LogicalType::String))
            .build(),
        Kind::Count => field.with_converted_type(ConvertedType::UINT_64).build(),
        _ => field.build(),
    }
}

/// Writes the cells of a column; an empty one is null.
fn fill(
    column: &mut SerializedColumnWriter<'_>,
    kind: Kind,
    cells: &[String],
) -> Result<(), ParquetError> {
    let levels: Vec<i16> = cells.iter().map(|cell| i16::from(!cell.is_empty())).collect();
    let levels = Some(&levels[..]);
    let filled = || cells.iter().filter(|cell| !cell.is_empty());
    match kind {
        Kind::Integer => {
            let values = parsed::<i64>(filled())?;
            column.typed::<Int64Type>().write_batch(&values, levels, None)?;
        }
        Kind::Count => {
            // Unsigned numbers are stored as the signed ones with the same bits.
            let values: Vec<i64> =
                parsed::<u64>(filled())?.into_iter().map(u64::cast_signed).collect();
            column.typed::<Int64Type>().write_batch(&values, levels, None)?;
        }
        Kind::Number => {
            let values = parsed::<f64>(filled())?;
            column.typed::<DoubleType>().write_batch(&values, levels, None)?;
        }
        Kind::Flag => {
            let values = parsed::<bool>(filled())?;
            column.typed::<BoolType>().write_batch(&values, levels, None)?;
        }
        Kind::Text => {
            let values: Vec<ByteArray> = filled().map(|cell| cell.as_str().into()).collect();
            column.typed::<ByteArrayType>().write_batch(&values, levels, None)?;
        }
    }
    Ok(())
}

/// Reads cells of the same type.
fn parsed<'c, T: std::str::FromStr>(
    cells: impl Iterator<Item = &'c String>,
) -> Result<Vec<T>, ParquetError> {
    let wrong = |cell: &String| ParquetError::General(format!("{cell:?} does not fit its column"));
    cells.map(|cell| cell.parse().map_err(|_| wrong(cell))).collect()
}

#[cfg(test)]
mod tests {
    use super::super::results::COLUMNS;
    use super::*;
    use parquet::file::reader::{FileReader, SerializedFileReader};

    fn file(varied: &[&str]) -> Vec<u8> {
        let names: Vec<String> = ["key"].into_iter().chain(COLUMNS).map(str::to_owned).collect();
        let measured = [
            ["18446744073709551615", "1", "1", "0.5", "7", "99", "1.25", "false"],
            ["1", "1", "2", "", "", "", "", "true"],
        ];
        let mut columns = vec![varied.iter().map(|cell| (*cell).to_owned()).collect::<Vec<_>>()];
        columns.extend((0..8).map(|c| measured.iter().map(|row| row[c].to_owned()).collect()));
        encoded(&names, &columns).unwrap()
    }

    #[test]
    fn types_and_nulls_are_read_back() {
        let bytes = file(&["0.5", "2"]);
        assert_eq!(bytes, file(&["0.5", "2"]));
        let reader = SerializedFileReader::new(bytes::Bytes::from(bytes)).unwrap();
        let rows: Vec<String> =
            reader.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string()).collect();
        assert_eq!(
            rows,
            [
                "{key: 0.5, seed: 18446744073709551615, initial_state: 1, agent: 1, rmse: 0.5, broadcasts: 7, bytes: 99, \
                 max_error: 1.25, diverged: false}",
                "{key: 2.0, seed: 1, initial_state: 1, agent: 2, rmse: null, broadcasts: null, \
                 bytes: null, max_error: null, diverged: true}",
            ]
        );
    }

    #[test]
    fn keys_have_the_type_of_all_their_values() {
        let kind = |cells: &[&str]| {
            kind_of_key(&cells.iter().map(|cell| (*cell).to_owned()).collect::<Vec<_>>())
        };
        assert_eq!(kind(&["1", "2"]), Kind::Integer);
        assert_eq!(kind(&["1", "2.5"]), Kind::Number);
        assert_eq!(kind(&["true", "false"]), Kind::Flag);
        assert_eq!(kind(&["field", "2"]), Kind::Text);
    }
}
