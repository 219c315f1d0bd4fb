//! Sizes of the sensors of common cameras, for files that name the camera and not its field of view.
//!
//! Makers publish them in their cameras' specifications. A family of cameras has one row.

/// Long and short side, millimetres, of cameras whose maker and name contain these words.
struct Row {
    make: &'static str,
    /// Any of these, at the beginning of the name after the maker's.
    models: &'static [&'static str],
    size_mm: [f64; 2],
}

const FULL_FRAME: [f64; 2] = [36.0, 24.0];
const APS_C: [f64; 2] = [23.5, 15.6];
const APS_C_CANON: [f64; 2] = [22.3, 14.9];
const FOUR_THIRDS: [f64; 2] = [17.3, 13.0];
const ONE_INCH: [f64; 2] = [13.2, 8.8];

/// Names that begin with a longer word come first.
const ROWS: &[Row] = &[
    Row {
        make: "canon",
        models: &[
            "eos-1d x", "eos-1d c", "eos-1ds", "eos 5d", "eos 6d", "eos rp", "eos r3", "eos r5",
            "eos r6", "eos r8", "eos r1",
        ],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "canon",
        models: &[
            "eos r7",
            "eos r10",
            "eos r50",
            "eos r100",
            "eos rebel",
            "eos m",
        ],
        size_mm: APS_C_CANON,
    },
    Row {
        make: "canon",
        models: &["eos-1d"],
        size_mm: [27.9, 18.6],
    },
    Row {
        make: "canon",
        models: &["eos r"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "canon",
        models: &["eos"],
        size_mm: APS_C_CANON,
    },
    Row {
        make: "canon",
        models: &["powershot g1 x mark iii"],
        size_mm: APS_C_CANON,
    },
    Row {
        make: "canon",
        models: &["powershot g1 x"],
        size_mm: [18.7, 14.0],
    },
    Row {
        make: "canon",
        models: &[
            "powershot g3 x",
            "powershot g5 x",
            "powershot g7 x",
            "powershot g9 x",
            "powershot v10",
        ],
        size_mm: ONE_INCH,
    },
    Row {
        make: "nikon",
        models: &["z fc"],
        size_mm: APS_C,
    },
    Row {
        make: "nikon",
        models: &[
            "d3", "d4", "d5", "d6", "d600", "d610", "d700", "d750", "d780", "d800", "d810", "d850",
            "df", "z 5", "z 6", "z 7", "z 8", "z 9", "z f", "z5", "z6", "z7", "zr",
        ],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "nikon",
        models: &["d", "z 30", "z 50", "z50"],
        size_mm: APS_C,
    },
    Row {
        make: "nikon",
        models: &["1 aw", "1 j", "1 s", "1 v"],
        size_mm: ONE_INCH,
    },
    Row {
        make: "nikon",
        models: &["coolpix p6000"],
        size_mm: [7.44, 5.58],
    },
    Row {
        make: "sony",
        models: &[
            "ilce-1",
            "ilce-7",
            "ilce-9",
            "ilca-99",
            "slt-a99",
            "dslr-a850",
            "dslr-a900",
            "dsc-rx1",
            "ilme-fx2",
            "ilme-fx3",
            "ilme-fx6",
            "ilx-lr1",
            "nex-vg900",
            "zv-e1",
        ],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "sony",
        models: &[
            "ilce-",
            "ilca-",
            "ilme-fx30",
            "slt-",
            "dslr-",
            "nex-",
            "zv-e10",
        ],
        size_mm: APS_C,
    },
    Row {
        make: "sony",
        models: &["dsc-rx0", "dsc-rx10", "dsc-rx100", "zv-1"],
        size_mm: ONE_INCH,
    },
    Row {
        make: "fujifilm",
        models: &["gfx"],
        size_mm: [43.8, 32.9],
    },
    Row {
        make: "fujifilm",
        models: &["x-s1", "x10", "x20", "x30"],
        size_mm: [8.8, 6.6],
    },
    Row {
        make: "fujifilm",
        models: &["x-hf1"],
        size_mm: ONE_INCH,
    },
    Row {
        make: "fujifilm",
        models: &["finepix x100", "x-", "x100", "x70", "xf10"],
        size_mm: APS_C,
    },
    Row {
        make: "olympus",
        models: &["e-10", "e-20"],
        size_mm: [8.8, 6.6],
    },
    Row {
        make: "olympus",
        models: &["e-", "pen-f"],
        size_mm: FOUR_THIRDS,
    },
    Row {
        make: "om digital",
        models: &["e-", "om-"],
        size_mm: FOUR_THIRDS,
    },
    Row {
        make: "panasonic",
        models: &["dc-bs1", "dc-s"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "panasonic",
        models: &["dc-bgh1", "dc-g", "dmc-g", "dmc-l1", "dmc-l10"],
        size_mm: FOUR_THIRDS,
    },
    Row {
        make: "panasonic",
        models: &[
            "dc-fz1000",
            "dc-tz200",
            "dc-zs200",
            "dmc-fz1000",
            "dmc-fz2000",
            "dmc-fz2500",
            "dmc-lx10",
            "dmc-lx15",
            "dmc-lx9",
            "dmc-tz100",
            "dmc-zs100",
        ],
        size_mm: ONE_INCH,
    },
    Row {
        make: "leica",
        models: &["m8"],
        size_mm: [27.0, 18.0],
    },
    Row {
        make: "leica",
        models: &["m", "q", "sl"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "leica",
        models: &["s (typ", "s-e", "s2", "s3"],
        size_mm: [45.0, 30.0],
    },
    Row {
        make: "leica",
        models: &[
            "cl", "t (typ", "tl", "x (typ", "x vario", "x-e", "x-u", "x1", "x2",
        ],
        size_mm: APS_C,
    },
    Row {
        make: "leica",
        models: &["digilux 3"],
        size_mm: FOUR_THIRDS,
    },
    Row {
        make: "pentax",
        models: &["k-1"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "pentax",
        models: &[
            "*ist d", "k-", "k10", "k20", "k100", "k110", "k200", "k2000",
        ],
        size_mm: APS_C,
    },
    Row {
        make: "pentax",
        models: &["645d"],
        size_mm: [44.0, 33.0],
    },
    Row {
        make: "ricoh",
        models: &["pentax 645z"],
        size_mm: [43.8, 32.8],
    },
    Row {
        make: "ricoh",
        models: &["pentax k-1"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "ricoh",
        models: &["gr digital"],
        size_mm: [7.3, 5.5],
    },
    Row {
        make: "ricoh",
        models: &["gr", "pentax k"],
        size_mm: APS_C,
    },
    Row {
        make: "sigma",
        models: &["bf", "fp"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "dji",
        models: &["fc3411", "fc6310", "fc6510"],
        size_mm: ONE_INCH,
    },
    Row {
        make: "dji",
        models: &["fc550", "fc6520"],
        size_mm: FOUR_THIRDS,
    },
    Row {
        make: "dji",
        models: &["fc6540"],
        size_mm: APS_C,
    },
    Row {
        make: "dji",
        models: &["zenmusep1"],
        size_mm: FULL_FRAME,
    },
    Row {
        make: "hasselblad",
        models: &["l1d"],
        size_mm: ONE_INCH,
    },
    Row {
        make: "hasselblad",
        models: &["l2d"],
        size_mm: FOUR_THIRDS,
    },
    Row {
        make: "hasselblad",
        models: &["907x", "x1d", "x2d"],
        size_mm: [43.8, 32.9],
    },
    Row {
        make: "dji",
        models: &[
            "fc1102", "fc220", "fc2204", "fc300", "fc330", "fc350", "fc7203", "fc7303",
        ],
        size_mm: [6.17, 4.55],
    },
];

/// Long and short side of the sensor of a camera, millimetres, if the table has it.
pub(crate) fn size_mm(make: Option<&str>, model: Option<&str>) -> Option<[f64; 2]> {
    let (make, model) = (make?.to_lowercase(), model?.to_lowercase());
    // Some makers begin the name with their own; that of an OM-1 is no more than its own.
    let first = make.split_whitespace().next().unwrap_or_default();
    let name = model
        .strip_prefix(&make)
        .or_else(|| model.strip_prefix(first))
        .unwrap_or(&model)
        .trim_start();
    let is_named = |word: &&str| begins(name, word) || begins(&model, word);
    let fits = |row: &&Row| make.starts_with(row.make) && row.models.iter().any(is_named);
    ROWS.iter().find(fits).map(|row| row.size_mm)
}

/// Whether `name` begins with `word`, which does not end within a number of the name.
fn begins(name: &str, word: &str) -> bool {
    let Some(rest) = name.strip_prefix(word) else {
        return false;
    };
    let digit = |c: Option<char>| c.is_some_and(|c| c.is_ascii_digit());
    !(digit(word.chars().last()) && digit(rest.chars().next()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_are_found_by_family_and_unknown_ones_are_not() {
        let size = |make, model| size_mm(Some(make), Some(model));
        assert_eq!(size("Canon", "Canon EOS 5D Mark IV"), Some(FULL_FRAME));
        assert_eq!(size("Canon", "Canon EOS R10"), Some(APS_C_CANON));
        assert_eq!(size("Canon", "Canon EOS R"), Some(FULL_FRAME));
        assert_eq!(size("Canon", "Canon EOS 550D"), Some(APS_C_CANON));
        assert_eq!(size("NIKON CORPORATION", "NIKON D5"), Some(FULL_FRAME));
        assert_eq!(size("NIKON CORPORATION", "NIKON D5600"), Some(APS_C));
        assert_eq!(size("NIKON", "COOLPIX P6000"), Some([7.44, 5.58]));
        assert_eq!(size("SONY", "ILCE-7M3"), Some(FULL_FRAME));
        assert_eq!(size("SONY", "ILCE-6000"), Some(APS_C));
        assert_eq!(size("SONY", "DSC-RX1"), Some(FULL_FRAME));
        assert_eq!(size("SONY", "DSC-RX10M4"), Some(ONE_INCH));
        assert_eq!(size("SONY", "DSC-RX100"), Some(ONE_INCH));
        assert_eq!(size("SONY", "DSC-RX100M7"), Some(ONE_INCH));
        assert_eq!(size("FUJIFILM", "X-T3"), Some(APS_C));
        assert_eq!(size("FUJIFILM", "X-S10"), Some(APS_C));
        assert_eq!(size("OLYMPUS CORPORATION", "E-M1MarkII"), Some(FOUR_THIRDS));
        assert_eq!(size("Apple", "iPhone 12"), None);
        assert_eq!(size_mm(None, Some("E-M1")), None);
    }

    #[test]
    fn a_camera_whose_name_begins_as_anothers_has_its_own_sensor() {
        let size = |make, model| size_mm(Some(make), Some(model));
        assert_eq!(size("Canon", "Canon EOS REBEL T3i"), Some(APS_C_CANON));
        assert_eq!(size("Canon", "Canon EOS-1D C"), Some(FULL_FRAME));
        assert_eq!(size("NIKON CORPORATION", "NIKON Z fc"), Some(APS_C));
        assert_eq!(size("NIKON CORPORATION", "NIKON Z f"), Some(FULL_FRAME));
        assert_eq!(size("SONY", "DSLR-A900"), Some(FULL_FRAME));
        assert_eq!(size("SONY", "DSLR-A580"), Some(APS_C));
        assert_eq!(size("FUJIFILM", "X-S1"), Some([8.8, 6.6]));
        assert_eq!(size("Hasselblad", "L1D-20c"), Some(ONE_INCH));
        assert_eq!(size("OM Digital Solutions", "OM-1"), Some(FOUR_THIRDS));
        assert_eq!(size("RICOH", "GR DIGITAL 4"), Some([7.3, 5.5]));
        assert_eq!(
            size("RICOH IMAGING COMPANY, LTD.", "RICOH GR III"),
            Some(APS_C)
        );
    }

    #[test]
    fn newer_cameras_and_those_beside_them_in_a_family_have_their_sensors() {
        let size = |make, model| size_mm(Some(make), Some(model));
        for (make, model, want) in [
            ("Canon", "Canon EOS R5m2", FULL_FRAME),
            ("Canon", "Canon EOS R6 Mark II", FULL_FRAME),
            ("Canon", "Canon EOS R50 V", APS_C_CANON),
            ("Canon", "Canon PowerShot G1 X Mark II", [18.7, 14.0]),
            ("Canon", "Canon PowerShot G1 X Mark III", APS_C_CANON),
            ("NIKON CORPORATION", "NIKON Z 7_2", FULL_FRAME),
            ("NIKON CORPORATION", "NIKON Z6_3", FULL_FRAME),
            ("NIKON CORPORATION", "NIKON Z5_2", FULL_FRAME),
            ("NIKON CORPORATION", "NIKON Z50_2", APS_C),
            ("NIKON CORPORATION", "NIKON 1 J5", ONE_INCH),
            ("SONY", "ILCE-7CM2", FULL_FRAME),
            ("SONY", "ILME-FX3", FULL_FRAME),
            ("SONY", "ILME-FX30", APS_C),
            ("SONY", "ZV-E1", FULL_FRAME),
            ("SONY", "ZV-E10M2", APS_C),
            ("SONY", "ZV-1M2", ONE_INCH),
            ("SONY", "NEX-VG900", FULL_FRAME),
            ("SONY", "NEX-7", APS_C),
            ("FUJIFILM", "GFX100S II", [43.8, 32.9]),
            ("FUJIFILM", "X100VI", APS_C),
            ("FUJIFILM", "X10", [8.8, 6.6]),
            ("FUJIFILM", "X-HF1", ONE_INCH),
            ("FUJIFILM", "X-H2S", APS_C),
            ("OLYMPUS IMAGING CORP.", "E-20,E-20N,E-20P", [8.8, 6.6]),
            ("OLYMPUS CORPORATION", "PEN-F", FOUR_THIRDS),
            ("OM Digital Solutions", "OM-5", FOUR_THIRDS),
            ("Panasonic", "DC-S5M2", FULL_FRAME),
            ("Panasonic", "DC-GH7", FOUR_THIRDS),
            ("Panasonic", "DMC-LX15", ONE_INCH),
            ("Leica Camera AG", "LEICA Q3 43", FULL_FRAME),
            ("Leica Camera AG", "LEICA SL3", FULL_FRAME),
            ("LEICA CAMERA AG", "LEICA S3", [45.0, 30.0]),
            ("LEICA CAMERA AG", "LEICA TL2", APS_C),
            ("RICOH IMAGING COMPANY, LTD.", "PENTAX 645Z", [43.8, 32.8]),
            ("RICOH IMAGING COMPANY, LTD.", "RICOH GR IIIx", APS_C),
            ("SIGMA", "SIGMA BF", FULL_FRAME),
            ("DJI", "FC3411", ONE_INCH),
            ("DJI", "FC7303", [6.17, 4.55]),
            ("Hasselblad", "L2D-20c", FOUR_THIRDS),
            ("Hasselblad", "X2D 100C", [43.8, 32.9]),
        ] {
            assert_eq!(size(make, model), Some(want), "{make} {model}");
        }
        // Its lens is a fisheye, and telephones have several sensors: the equivalent focal length tells.
        assert_eq!(size("GoPro", "HERO11 Black"), None);
        assert_eq!(size("Panasonic", "DMC-LX100"), None);
    }

    #[test]
    fn every_name_of_the_table_finds_its_own_row() {
        for row in ROWS {
            for model in row.models {
                assert_eq!(
                    size_mm(Some(row.make), Some(model)),
                    Some(row.size_mm),
                    "{} {model}",
                    row.make
                );
            }
        }
    }
}
