//! Files of programs whose cameras are not read: what they are, and how their cameras can be read.
use serde_json::Value;

use crate::error::CameraError;

/// What a file is, and what to do instead.
type Known = (&'static str, &'static str);

const METASHAPE: Known = (
    "it is Metashape's .xml, which is not read",
    "export the cameras from Metashape 2 for COLMAP, or make transforms.json of it with \
     `ns-process-data metashape` of nerfstudio",
);
const REALITY: Known = (
    "it is RealityCapture's .csv, which is not read",
    "export the registration from RealityCapture for COLMAP, or make transforms.json of it with \
     `ns-process-data realitycapture` of nerfstudio",
);
const OPENCV_XML: Known = (
    "it is OpenCV's .xml, which is not read",
    "write it with OpenCV's FileStorage as .yaml",
);
const MESHROOM: Known = (
    "it is Meshroom's, which is not read",
    "make a model of COLMAP of it with `aliceVision_exportColmap`",
);
const OPENMVG: Known = (
    "it is OpenMVG's, which is not read",
    "make a model of COLMAP of it with `openMVG_main_openMVG2Colmap`",
);
const POLYCAM: Known = (
    "it is a picture's camera of Polycam, which is not read",
    "make transforms.json of the raw data with `ns-process-data polycam` of nerfstudio",
);
const RECORD3D: Known = (
    "it is Record3D's, which is not read",
    "make transforms.json of it with `ns-process-data record3d` of nerfstudio",
);
const SPLATS: Known = (
    "it is the list of cameras beside Gaussian splats, which is not read",
    "name the model of COLMAP that the splats were made of",
);
const SCENE: Known = (
    "it is a scene of a format that is not read",
    "open it in Blender, and export the camera as .chan, or at rest as .glb with cameras",
);

/// What is read, for files of any kind.
const READ: &str = "use .fspy, transforms.json, .chan, .glb, .gltf, COLMAP's folder or project, or a calibration \
                    of OpenCV (.yaml, .json), KITTI (.txt) or nuScenes (.json)";

fn error((detail, remedy): Known) -> CameraError {
    CameraError::with_remedy("camera's", detail, remedy)
}

/// Why a file with an extension that is not read is refused.
pub(crate) fn of_extension(extension: &str, bytes: &[u8]) -> CameraError {
    let has = |part: &[u8]| bytes.windows(part.len()).any(|window| window == part);
    error(match extension {
        "xml" if has(b"<opencv_storage") => OPENCV_XML,
        "xml" if has(b"<chunk") => METASHAPE,
        "csv" if has(b"heading") || has(b"#name") || has(b"#cameras") => REALITY,
        "sfm" => MESHROOM,
        "abc" | "blend" | "dae" | "fbx" | "ma" | "mb" | "nk" | "usd" | "usda" | "usdc" | "usdz" => {
            SCENE
        }
        _ => ("it is not a kind of file that is known", READ),
    })
}

/// Why JSON is refused, if it is none that is read.
pub(crate) fn of_json(json: &Value) -> Option<CameraError> {
    let record = json.get(0).unwrap_or(json);
    let has = |keys: &[&str]| keys.iter().all(|key| record.get(key).is_some());
    let known = match () {
        () if has(&["sfm_data_version"]) => OPENMVG,
        () if has(&["views", "intrinsics"]) => MESHROOM,
        () if has(&["t_00", "t_23"]) => POLYCAM,
        () if has(&["poses", "K"]) => RECORD3D,
        () if json.is_array() && has(&["position", "rotation", "fx"]) => SPLATS,
        () if json.is_array() || !json.is_object() => {
            ("it is no JSON of a camera that is known", READ)
        }
        () => return None,
    };
    Some(error(known))
}
