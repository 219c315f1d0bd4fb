//! Letters as strokes, for pictures without a font at hand.

/// Height of a capital in units of the grid.
pub const CAPITAL: f32 = 6.0;
/// Space between letters in units of the grid.
const GAP: f32 = 1.6;

/// The strokes of a letter: polylines of points as pairs of digits, x and y, separated by spaces;
/// polylines separated by commas. y counts upwards, 2 is the line that letters stand on.
fn strokes(letter: char) -> &'static str {
    match letter {
        '0' | 'O' => "03 07 18 38 47 43 32 12 03",
        '1' => "07 28 22,02 42",
        '2' => "07 18 38 47 46 02 42",
        '3' => "07 18 38 47 46 35 44 43 32 12 03,15 35",
        '4' => "32 38 04 44",
        '5' => "48 08 05 35 44 43 32 02",
        '6' => "38 18 07 03 12 32 43 44 35 05",
        '7' => "08 48 12",
        '8' => "15 06 07 18 38 47 46 35 15 04 03 12 32 43 44 35",
        '9' => "45 15 06 07 18 38 47 43 32 12",
        'A' => "02 28 42,14 34",
        'B' => "02 08 38 47 46 35 05,35 44 43 32 02",
        'C' => "47 38 18 07 03 12 32 43",
        'D' => "02 08 28 46 44 22 02",
        'E' => "48 08 02 42,05 35",
        'F' => "48 08 02,05 35",
        'G' => "47 38 18 07 03 12 32 43 45 25",
        'H' => "08 02,48 42,05 45",
        'I' => "08 02",
        'J' => "38 33 22 12 03",
        'K' => "08 02,48 05 42",
        'L' => "08 02 42",
        'M' => "02 08 25 48 42",
        'N' => "02 08 42 48",
        'P' => "02 08 38 47 46 35 05",
        'Q' => "03 07 18 38 47 43 32 12 03,24 42",
        'R' => "02 08 38 47 46 35 05,25 42",
        'S' => "47 38 18 07 06 15 35 44 43 32 12 03",
        'T' => "08 48,28 22",
        'U' => "08 03 12 32 43 48",
        'V' => "08 22 48",
        'W' => "08 12 26 32 48",
        'X' => "08 42,48 02",
        'Y' => "08 25 48,25 22",
        'Z' => "08 48 02 42",
        'a' => "06 26 35 32,34 14 03 12 22 33",
        'b' => "08 02 22 33 35 26 06",
        'c' => "36 16 05 03 12 32",
        'd' => "38 32 12 03 05 16 36",
        'e' => "04 34 35 26 16 05 03 12 32",
        'f' => "28 17 12,06 26",
        'g' => "36 16 05 03 12 32,36 31 20 10",
        'h' => "08 02,05 16 26 35 32",
        'i' => "06 02,08 08",
        'j' => "16 11 00,18 18",
        'k' => "08 02,36 04 32",
        'l' => "08 03 12",
        'm' => "02 06,05 16 25 22,25 36 45 42",
        'n' => "02 06,05 16 26 35 32",
        'o' => "05 16 26 35 33 22 12 03 05",
        'p' => "00 06 26 35 33 22 02",
        'q' => "30 36 16 05 03 12 32",
        'r' => "02 06,05 16 26",
        's' => "36 16 05 14 24 33 22 02",
        't' => "18 13 22 32,06 26",
        'u' => "06 03 12 22 33,36 32",
        'v' => "06 22 46",
        'w' => "06 12 24 32 46",
        'x' | '×' => "06 32,36 02",
        'y' => "06 22,46 10",
        'z' => "06 36 02 32",
        '.' => "02 02",
        ',' => "12 00",
        '-' => "05 35",
        '+' => "05 45,27 23",
        ':' => "03 03,06 06",
        '/' => "01 38",
        '(' => "18 07 03 12",
        ')' => "08 17 13 02",
        '[' => "18 08 02 12",
        ']' => "08 18 12 02",
        '%' => "02 48,08 08,42 42",
        '=' => "04 34,06 36",
        '<' => "47 05 43",
        '>' => "07 45 03",
        '_' => "02 42",
        '\'' => "08 07",
        '°' => "07 18 27 16 07",
        // A box stands for every letter without a glyph.
        _ => "02 08 48 42 02",
    }
}

/// A polyline in units of the grid, y upwards from the line that letters stand on.
pub type Stroke = Vec<(f32, f32)>;

/// The strokes of `text` from x = 0 on, and its width, in units of the grid.
pub fn lay_out(text: &str) -> (Vec<Stroke>, f32) {
    let mut lines = Vec::new();
    let mut x = 0.0;
    for letter in text.chars() {
        if letter == ' ' {
            x += 3.0;
            continue;
        }
        let mut widest = 0.0f32;
        for stroke in strokes(letter).split(',') {
            let points = stroke.split(' ').map(|pair| {
                let digit = |k: usize| f32::from(pair.as_bytes()[k] - b'0');
                widest = widest.max(digit(0));
                (x + digit(0), digit(1) - 2.0)
            });
            lines.push(points.collect());
        }
        x += widest + GAP;
    }
    (lines, (x - GAP).max(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_letter_is_made_of_points_on_the_grid() {
        for letter in (' '..='~').chain(['°', '×', 'ü']) {
            for stroke in strokes(letter).split(',') {
                for pair in stroke.split(' ') {
                    let bytes = pair.as_bytes();
                    assert!(
                        bytes.len() == 2 && bytes.iter().all(u8::is_ascii_digit),
                        "{letter}: {pair}"
                    );
                }
            }
        }
    }

    #[test]
    fn texts_are_as_wide_as_their_letters() {
        let width = |t: &str| lay_out(t).1;
        assert_eq!(width(""), 0.0);
        assert_eq!(width("A"), 4.0);
        assert!((width("AA") - 8.0 - GAP).abs() < 1e-5);
        assert!(width("a b") > width("ab"));
    }
}
