//! Text tables: right-aligned columns as wide as their widest entry.

/// A table: two lines of headings, and rows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Table {
    /// Adjacent columns with the same first line share it.
    pub headings: Vec<[String; 2]>,
    /// One entry for each column.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// Creates a table.
    #[must_use]
    pub fn new(headings: &[[&str; 2]], rows: Vec<Vec<String>>) -> Self {
        let headings = headings.iter().map(|heading| heading.map(str::to_owned)).collect();
        Self { headings, rows }
    }

    /// Formats it as [`aligned`] does.
    #[must_use]
    pub fn text(&self) -> String {
        let headings: Vec<[&str; 2]> =
            self.headings.iter().map(|[group, name]| [group.as_str(), name.as_str()]).collect();
        aligned(&headings, &self.rows)
    }
}

/// Formats a table with two heading lines, a rule, and the rows; missing entries are blank.
/// Adjacent columns with the same first line share it.
///
/// Widths are in characters, one terminal column each.
#[must_use]
pub fn aligned(headings: &[[&str; 2]], rows: &[Vec<String>]) -> String {
    let mut widths: Vec<usize> = headings.iter().map(|[_, name]| count(name)).collect();
    for row in rows {
        for (width, entry) in widths.iter_mut().zip(row) {
            *width = (*width).max(count(entry));
        }
    }
    let groups = groups(headings);
    for group in &groups {
        // The extra width of a long heading is distributed over its columns.
        let inside = &mut widths[group.columns.clone()];
        let missing = count(group.name).saturating_sub(span(inside));
        let columns = inside.len();
        for (index, width) in inside.iter_mut().enumerate() {
            *width += missing / columns + usize::from(index >= columns - missing % columns);
        }
    }
    let mut lines = Vec::with_capacity(rows.len() + 3);
    if groups.iter().any(|group| !group.name.is_empty()) {
        let widths: Vec<usize> =
            groups.iter().map(|group| span(&widths[group.columns.clone()])).collect();
        // A heading of several columns is centred.
        let centred = groups.iter().zip(&widths).map(|(group, &width)| {
            let room = if group.columns.len() > 1 { width - count(group.name) } else { 0 };
            format!("{}{}", group.name, " ".repeat(room / 2))
        });
        let centred: Vec<String> = centred.collect();
        lines.push(line(centred.iter().map(String::as_str), &widths));
    }
    lines.push(line(headings.iter().map(|[_, name]| *name), &widths));
    lines.push("-".repeat(span(&widths)));
    lines.extend(rows.iter().map(|row| line(row.iter().map(String::as_str), &widths)));
    lines.join("\n") + "\n"
}

/// Spaces between columns.
const GAP: usize = 2;

/// Columns that share the first line of their headings.
struct Group<'a> {
    name: &'a str,
    columns: std::ops::Range<usize>,
}

/// Returns the width of columns including the gaps between them.
fn span(widths: &[usize]) -> usize {
    widths.iter().sum::<usize>() + GAP * widths.len().saturating_sub(1)
}

fn groups<'a>(headings: &[[&'a str; 2]]) -> Vec<Group<'a>> {
    let mut groups: Vec<Group<'a>> = Vec::new();
    for (column, [name, _]) in headings.iter().enumerate() {
        match groups.last_mut() {
            Some(group) if group.name == *name && !name.is_empty() => {
                group.columns.end = column + 1;
            }
            _ => groups.push(Group { name, columns: column..column + 1 }),
        }
    }
    groups
}

fn line<'a>(entries: impl Iterator<Item = &'a str>, widths: &[usize]) -> String {
    let padded = entries.zip(widths).map(|(entry, &width)| format!("{entry:>width$}"));
    padded.collect::<Vec<_>>().join(&" ".repeat(GAP)).trim_end().to_owned()
}

fn count(text: &str) -> usize {
    text.chars().count()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_widest_entry() {
        let headings = [["", "agent"], ["RMSE", "a"], ["RMSE", "b"], ["a long group", "c"]];
        let row = |entries: [&str; 4]| entries.map(str::to_owned).to_vec();
        let rows = [row(["1", "0.1000", "1.234e-10", "-"]), row(["100", "2", "3", "4"])];
        let expected = [
            "              RMSE        a long group",
            "agent       a          b             c",
            "--------------------------------------",
            "    1  0.1000  1.234e-10             -",
            "  100       2          3             4",
            "",
        ];
        assert_eq!(aligned(&headings, &rows), expected.join("\n"));
        let headings = [["a heading of two", "a"], ["a heading of two", "b"]];
        let lines =
            ["a heading of two", "      a        b", "----------------", "      1        2", ""];
        let rows = [vec!["1".to_owned(), "2".to_owned()]];
        assert_eq!(aligned(&headings, &rows), lines.join("\n"));
    }

    #[test]
    fn table_without_groups_has_one_heading_line() {
        let rows = [vec!["1".to_owned(), "−2".to_owned()]];
        assert_eq!(aligned(&[["", "a"], ["", "b"]], &rows), "a   b\n-----\n1  −2\n");
    }
}
