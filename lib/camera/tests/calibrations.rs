//! Calibrations that cannot be read.
use dipir_cameras::opencv;

/// A lens that cannot be read is not a lens without distortion.
#[test]
fn what_is_no_number_in_a_calibration_is_quoted() {
    let read = |text: &str| opencv::read(text, Some([640.0, 480.0])).map_err(|e| e.to_string());
    let yaml = "K: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: [0.1, -0.2]\n";
    let json = "{\"K\": [500, 0, 320, 0, 500, 240, 0, 0, 1], \"D\": [0.1, null]}";
    assert!(read(yaml).is_ok() && read(json).is_ok());
    for (text, word) in [
        (yaml.replace("-0.2", ".Nan"), ".Nan"),
        (yaml.replace("320", "five"), "five"),
        (json.replace("null", "true"), "true"),
    ] {
        let error = read(&text).unwrap_err();
        assert!(error.contains(&format!("{word:?} is no number")), "{error}");
    }
}
