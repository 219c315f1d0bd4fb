//! Files of programs whose cameras are not read: each is named, with a way to one that is.
mod found;

use std::path::Path;

use dipir_cameras::file::Which;
use serde_json::json;

use crate::found::found_x;

#[test]
fn a_file_of_a_program_that_is_not_read_says_how_its_camera_can_be() {
    let splats =
        json!([{ "img_name": "a", "position": [0, 0, 0], "rotation": [[1, 0, 0]], "fx": 9 }]);
    let openmvg = json!({ "sfm_data_version": "0.3", "views": [], "intrinsics": [{ "key": 0 }] });
    let meshroom = json!({ "version": ["1"], "views": [], "intrinsics": [{ "type": "radial3" }] });
    let polycam = json!({ "t_00": 1, "t_23": 0, "fx": 500, "cx": 300 });
    let record3d =
        json!({ "K": [500, 0, 0, 0, 500, 0, 300, 200, 1], "poses": [[0, 0, 0, 1, 0, 0, 0]] });
    let metashape = "<?xml version=\"1.0\"?>\n<document><chunk label=\"a\"/></document>";
    for (name, text, want) in [
        (
            "cameras.json",
            splats.to_string(),
            "name the model of COLMAP",
        ),
        (
            "sfm_data.json",
            openmvg.to_string(),
            "openMVG_main_openMVG2Colmap",
        ),
        ("sfm.json", meshroom.to_string(), "aliceVision_exportColmap"),
        ("sfm.sfm", meshroom.to_string(), "aliceVision_exportColmap"),
        ("1.json", polycam.to_string(), "ns-process-data polycam"),
        (
            "metadata.json",
            record3d.to_string(),
            "ns-process-data record3d",
        ),
        ("cameras.xml", metashape.into(), "ns-process-data metashape"),
        ("lens.xml", "<opencv_storage/>".into(), "as .yaml"),
        (
            "a.csv",
            "#name,x,y,alt,heading,pitch,roll,f\n".into(),
            "ns-process-data realitycapture",
        ),
        ("shot.FBX", "Kaydara".into(), "open it in Blender"),
        ("list.json", "[1]".into(), "use .fspy, transforms.json"),
        ("shot.3dm", String::new(), "use .fspy, transforms.json"),
        (
            "poses.txt",
            "1 0 0 0 0 1 0 0 0 0 1 0\n".into(),
            "KITTI's calib.txt is read",
        ),
        (
            "other.json",
            "{\"fx\": 9}".into(),
            "neither a camera_matrix",
        ),
    ] {
        let error = found_x(name, &text, Which::Photo(Path::new("a.png"))).unwrap_err();
        assert!(error.contains(want), "{name}: {error}");
    }
}
