//! Tables for papers: LaTeX's `tabular` with the rules of the package booktabs.

use super::columns::Table;

/// Formats a table; `title` becomes a comment above it.
#[must_use]
pub fn latex(title: &str, table: &Table) -> String {
    let Table { headings, rows } = table;
    let is_number = |column: usize| {
        rows.iter().filter_map(|row| row.get(column)).all(|entry| number(entry).is_some())
    };
    let alignment: String =
        (0..headings.len()).map(|column| if is_number(column) { 'r' } else { 'l' }).collect();
    let mut text = format!(
        "% {}; needs \\usepackage{{booktabs}}\n\\begin{{tabular}}{{{alignment}}}\n\\toprule\n",
        title.replace('\n', " ")
    );
    let groups = groups(headings);
    if groups.iter().any(|(name, _)| !name.is_empty()) {
        let cells = groups.iter().map(|(name, columns)| match columns.len() {
            1 => escaped(name),
            count => format!("\\multicolumn{{{count}}}{{c}}{{{}}}", escaped(name)),
        });
        text += &line(cells);
        for (_, columns) in groups.iter().filter(|(name, _)| !name.is_empty()) {
            text += &format!("\\cmidrule(lr){{{}-{}}}", columns.start + 1, columns.end);
        }
        text += "\n";
    }
    text += &line(headings.iter().map(|[_, name]| escaped(name)));
    text += "\\midrule\n";
    for row in rows {
        text += &line(row.iter().map(|entry| number(entry).unwrap_or_else(|| escaped(entry))));
    }
    text + "\\bottomrule\n\\end{tabular}\n"
}

fn line(cells: impl Iterator<Item = String>) -> String {
    format!("{} \\\\\n", cells.collect::<Vec<_>>().join(" & "))
}

/// Returns adjacent columns that share the first line of their headings.
fn groups(headings: &[[String; 2]]) -> Vec<(&str, std::ops::Range<usize>)> {
    let mut groups: Vec<(&str, std::ops::Range<usize>)> = Vec::new();
    for (column, [name, _]) in headings.iter().enumerate() {
        match groups.last_mut() {
            Some((last, columns)) if *last == name && !name.is_empty() => columns.end = column + 1,
            _ => groups.push((name, column..column + 1)),
        }
    }
    groups
}

/// Returns a number, or a dash for a missing one, as LaTeX sets it; `None` for other entries.
fn number(entry: &str) -> Option<String> {
    if matches!(entry, "" | "-") {
        return Some(if entry.is_empty() { String::new() } else { "--".to_owned() });
    }
    entry.parse::<f64>().ok().filter(|number| number.is_finite())?;
    let plain = entry.trim_start_matches('+');
    Some(match plain.split_once('e') {
        Some((mantissa, exponent)) => format!("${mantissa} \\times 10^{{{exponent}}}$"),
        None if plain.starts_with('-') => format!("${plain}$"),
        None => plain.to_owned(),
    })
}

fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' | '%' | '$' | '#' | '_' | '{' | '}' => escaped.extend(['\\', c]),
            '~' => escaped += "\\textasciitilde{}",
            '^' => escaped += "\\textasciicircum{}",
            '\\' => escaped += "\\textbackslash{}",
            '|' => escaped += "\\textbar{}",
            '<' => escaped += "\\textless{}",
            '>' => escaped += "\\textgreater{}",
            _ => escaped.push(c),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_groups_numbers_and_escaped_words() {
        let headings =
            [["", "method"], ["RMSE", "agent 1"], ["RMSE", "agent 2"], ["", "change [%]"]];
        let row = |entries: [&str; 4]| entries.map(str::to_owned).to_vec();
        let table = Table::new(
            &headings,
            vec![row(["known_f", "0.034", "1.2e-10", "-12.9"]), row(["a & b", "-", "2", "+3"])],
        );
        let expected = "% Errors; needs \\usepackage{booktabs}\n\
            \\begin{tabular}{lrrr}\n\
            \\toprule\n \
             & \\multicolumn{2}{c}{RMSE} &  \\\\\n\
            \\cmidrule(lr){2-3}\n\
            method & agent 1 & agent 2 & change [\\%] \\\\\n\
            \\midrule\n\
            known\\_f & 0.034 & $1.2 \\times 10^{-10}$ & $-12.9$ \\\\\n\
            a \\& b & -- & 2 & 3 \\\\\n\
            \\bottomrule\n\
            \\end{tabular}\n";
        assert_eq!(latex("Errors", &table), expected);
    }
}
