//! What is known of one artifact, for people and for programs.
use serde_json::Value;

/// One artifact.
pub struct Report {
    /// First line: the path and what it is.
    pub title: String,
    /// The rest, for people.
    pub text: String,
    /// All of it, for programs.
    pub json: Value,
    /// What is wrong with it, one sentence each.
    pub problems: Vec<String>,
}

/// A table with columns aligned: the first to the left, numbers to the right.
pub struct Table {
    rows: Vec<Vec<String>>,
    right: Vec<bool>,
}

impl Table {
    /// A table with the given heads; `>` in front aligns a column to the right.
    pub fn new(heads: &[&str]) -> Self {
        Self {
            right: heads.iter().map(|h| h.starts_with('>')).collect(),
            rows: vec![
                heads
                    .iter()
                    .map(|h| h.trim_start_matches('>').to_string())
                    .collect(),
            ],
        }
    }

    /// Adds a row.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.rows.push(cells.into_iter().collect());
    }

    /// The table, each line indented by two spaces.
    pub fn render(&self) -> String {
        let width = |column: usize| {
            self.rows
                .iter()
                .map(|r| r[column].chars().count())
                .max()
                .unwrap_or(0)
        };
        let widths: Vec<usize> = (0..self.right.len()).map(width).collect();
        let mut text = String::new();
        for row in &self.rows {
            let mut line = String::from(" ");
            for ((cell, &width), &right) in row.iter().zip(&widths).zip(&self.right) {
                let pad = " ".repeat(width - cell.chars().count());
                line.push(' ');
                line.push_str(&match right {
                    true => format!("{pad}{cell}"),
                    false => format!("{cell}{pad}"),
                });
                line.push(' ');
            }
            text.push_str(line.trim_end());
            text.push('\n');
        }
        text
    }
}

/// A number with five digits: plain from .001 to a million, else with an exponent.
pub fn number(value: f64) -> String {
    let size = value.abs();
    if value == 0.0 {
        "0".into()
    } else if !value.is_finite() {
        value.to_string()
    } else if (1e-3..1e6).contains(&size) {
        let digits = (4 - size.log10().floor() as i32).clamp(0, 6) as usize;
        let text = format!("{value:.digits$}");
        match text.contains('.') {
            true => text.trim_end_matches('0').trim_end_matches('.').into(),
            false => text,
        }
    } else {
        format!("{value:.3e}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_five_digits() {
        assert_eq!(number(0.0), "0");
        assert_eq!(number(1.0), "1");
        assert_eq!(number(0.1234567), "0.12346");
        assert_eq!(number(-65504.0), "-65504");
        assert_eq!(number(1.5e-7), "1.500e-7");
        assert_eq!(number(f64::INFINITY), "inf");
    }

    #[test]
    fn tables_align_numbers_to_the_right() {
        let mut table = Table::new(&["name", ">count"]);
        table.row(["a".into(), "1".into()]);
        table.row(["long".into(), "1234567".into()]);
        assert_eq!(
            table.render(),
            "  name    count\n  a           1\n  long  1234567\n"
        );
    }
}
