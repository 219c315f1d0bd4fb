//! Requests that nobody thought of.
use dipir_placing::desk::Desk;
use dipir_placing::edit::Edit;
use dipir_placing::vanishing::Lines;
use serde_json::{Value, from_str};

mod project;
use project::project;

/// An edit of everything, lines, and a length.
const ASKED: [&str; 2] = [
    r#"{"objects": [{"of": 0, "at": [140.0, 150.5], "yaw_deg": 30.0, "size": 1.5}, {"of": 0}],
        "turn": {"pitch_deg": -9.5, "roll_deg": 1.0, "fov_deg": 48.0}, "height_m": 1.7,
        "sun": {"azimuth_deg": 30.0, "elevation_deg": 40.0}, "exposure_ev": 0.5, "mask": false,
        "shadow": {"foot": [20.0, 170.0], "tip": [60.0, 150.0], "height_m": 2.0}}"#,
    r#"{"first": [[[60.0, 190.0], [155.0, 126.0]], [[290.0, 190.0], [270.0, 126.0]]], "direction": "level",
        "second": [[[290.0, 150.0], [100.0, 122.7]], [[290.0, 190.0], [100.0, 150.3]]]}"#,
];
/// What numbers are replaced with.
const NUMBERS: [&str; 14] = [
    "0",
    "-0.0",
    "1e-300",
    "1e300",
    "-1e7",
    "9.9e6",
    "89.9999999",
    "-90",
    "180",
    "100",
    "1e400",
    "18446744073709551615",
    "null",
    "[]",
];

/// Numbers that depend on the seed alone.
struct Numbers(u64);

impl Numbers {
    fn below(&mut self, count: usize) -> usize {
        self.0 = self
            .0
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (self.0 >> 33) as usize % count
    }
}

/// `text` with one to three numbers replaced, and now and then a byte.
fn changed(text: &str, numbers: &mut Numbers) -> String {
    let mut text = text.to_owned();
    for _ in 0..=numbers.below(3) {
        let is_part = |c: char| c.is_ascii_digit() || ".-e".contains(c);
        let starts: Vec<usize> = (1..text.len())
            .filter(|&k| text[k..].starts_with(|c: char| c.is_ascii_digit() || c == '-'))
            .filter(|&k| text[..k].ends_with([' ', '[']))
            .collect();
        let Some(&start) = starts.get(numbers.below(starts.len().max(1))) else {
            break;
        };
        let end = text[start..]
            .find(|c| !is_part(c))
            .map_or(text.len(), |n| start + n);
        text.replace_range(start..end, NUMBERS[numbers.below(NUMBERS.len())]);
    }
    if numbers.below(8) == 0 {
        let at = numbers.below(text.len());
        text.replace_range(at..=at, ["", "]", "\"", "\0"][numbers.below(4)]);
    }
    text
}

#[test]
fn requests_of_changed_numbers_and_bytes_end_in_an_answer_or_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let desk = Desk::open(project(folder.path(), &[])).unwrap();
    let whole: Edit = from_str(ASKED[0]).unwrap();
    desk.view(&whole, true).unwrap();
    desk.solve(&whole, &from_str(ASKED[1]).unwrap()).unwrap();
    let mut numbers = Numbers(1);
    let mut answered = 0;
    for _ in 0..500 {
        let Ok(edit) = from_str::<Edit>(&changed(ASKED[0], &mut numbers)) else {
            continue;
        };
        if let Ok(view) = desk.view(&edit, true) {
            answered += 1;
            // JSON says null for what is no number.
            let camera = view["camera"].as_object().unwrap();
            assert!(
                camera.values().all(Value::is_number),
                "{edit:?}: {camera:?}"
            );
        }
        let Ok(lines) = from_str::<Lines>(&changed(ASKED[1], &mut numbers)) else {
            continue;
        };
        if let Ok(found) = desk.solve(&edit, &lines) {
            for turn in [found.turn, found.uncertain_deg] {
                let all = [turn.pitch_deg, turn.roll_deg, turn.fov_deg];
                assert!(all.iter().all(|a| a.is_finite()), "{lines:?}: {found:?}");
            }
        }
        let [ends, _] = lines.first;
        if let Ok(height) = desk.measure(&edit, ends, 1.0) {
            assert!(height.is_finite(), "{edit:?} {ends:?}");
        }
    }
    assert!(answered > 50, "{answered}");
}
