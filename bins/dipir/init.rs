//! `dipir init`.
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use dipir_cli::args::OutputArgs;
use dipir_cli::exit::{Usage, printable};
use dipir_cli::output::json_path;
use dipir_setup::view::CameraOptions;
use dipir_setup::{Draft, Request, SetupError, draft};
use dipir_stages::report::quoted;
use serde_json::{Value, json};

#[derive(Args)]
pub struct InitArgs {
    /// The photograph
    #[arg(value_name = "PHOTO")]
    photo: PathBuf,

    /// The objects, .glb, .gltf, .obj, .ply or .stl
    #[arg(value_name = "MODEL", required = true)]
    models: Vec<PathBuf>,

    /// The file to write; a file that is there is never overwritten
    #[arg(
        long,
        short = 'o',
        value_name = "FILE",
        default_value = "pipeline.toml"
    )]
    out: PathBuf,

    /// Height of the objects, metres [default: their files' own size, in metres or the unit that is
    /// likely, else 1]
    #[arg(long, value_name = "H")]
    height_m: Option<f64>,

    /// What the object is called in prompts [default: the name of the first model's file]
    #[arg(long, value_name = "WORD")]
    class: Option<String>,

    /// The photograph's camera from another program: fSpy's .fspy or .json, transforms.json, .chan,
    /// .glb, .gltf, a folder of COLMAP's, KITTI's .txt, nuScenes' .json
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,

    /// Which camera of that file, by the name of its picture or its own [default: that of the photograph's
    /// name]
    #[arg(long, value_name = "NAME", requires = "camera")]
    camera_image: Option<String>,

    /// Which camera of that file, by number from 0; of .chan and of a glTF camera that moves the number
    /// of the frame, of KITTI's n of Pn
    #[arg(long, value_name = "N", requires = "camera")]
    camera_frame: Option<u32>,

    /// Which axis of that camera's world points up [default: as the program that wrote it has it]
    #[arg(long, value_name = "AXIS", requires = "camera")]
    camera_up: Option<Axis>,

    /// Field of view along the photograph's longer side, degrees [default: what the photograph
    /// says, else what it shows, else 55]
    #[arg(long, value_name = "DEG")]
    fov: Option<f64>,

    /// How far the camera looks up (or, below 0, down), degrees [default: what the photograph
    /// shows, else with the horizon about 40% from the top]
    #[arg(
        long,
        value_name = "DEG",
        allow_negative_numbers = true,
        conflicts_with = "camera"
    )]
    pitch: Option<f64>,

    /// Height of the camera over the ground, metres [default: 1.6]
    #[arg(long, value_name = "M")]
    eye_height: Option<f64>,

    /// Points of the scene, which tell the ground: .ply, .pcd, .bin of a scanner, COLMAP's points3D, or
    /// depths of the photograph as .exr (metres) or .png (16 bits, millimetres)
    #[arg(long, value_name = "FILE")]
    points: Option<PathBuf>,

    /// Where the sensor of the points stood: KITTI's calib.txt, or its record of nuScenes as .json
    #[arg(long, value_name = "FILE", requires = "points")]
    points_pose: Option<PathBuf>,

    /// Which axis of the points points up [default: as their format has it]
    #[arg(long, value_name = "AXIS", requires = "points")]
    points_up: Option<Axis>,

    /// Depths of the photograph at any scale, as a depth network or a scanner gives them, .exr or .png in shades of
    /// grey: what is nearer than an object stands in front of it
    #[arg(long, value_name = "FILE")]
    depth: Option<PathBuf>,

    /// Where the objects stand: side by side in the middle, or wherever the ground is free and seen
    #[arg(long, value_name = "HOW", default_value = "middle")]
    place: Place,

    #[command(flatten)]
    output: OutputArgs,
}

/// How places are chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Place {
    /// Side by side
    Middle,
    /// Free ground that is seen, looked for on every run
    Auto,
}

/// An axis of a camera's world.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Axis {
    /// +y
    Y,
    /// +z
    Z,
    /// -y
    MinusY,
    /// +x
    X,
    /// -x
    MinusX,
}

impl From<Axis> for dipir_cameras::WorldUp {
    fn from(axis: Axis) -> Self {
        match axis {
            Axis::Y => Self::Y,
            Axis::Z => Self::Z,
            Axis::MinusY => Self::MinusY,
            Axis::X => Self::X,
            Axis::MinusX => Self::MinusX,
        }
    }
}

/// Writes a first `pipeline.toml` and says what to do with it.
pub fn run(args: &InitArgs) -> anyhow::Result<()> {
    let request = Request {
        photo: args.photo.clone(),
        models: args.models.clone(),
        out: args.out.clone(),
        height_m: args.height_m,
        class: args.class.clone(),
        camera: args.camera.clone(),
        camera_image: args.camera_image.clone(),
        camera_frame: args.camera_frame,
        camera_up: args.camera_up.map(Into::into),
        asked: CameraOptions {
            fov_deg: args.fov,
            pitch_deg: args.pitch,
            eye_height_m: args.eye_height,
        },
        points: args.points.clone(),
        points_pose: args.points_pose.clone(),
        points_up: args.points_up.map(Into::into),
        depth: args.depth.clone(),
        place_auto: args.place == Place::Auto,
    };
    let draft = draft(&request).map_err(classified)?;
    draft.write().map_err(classified)?;
    for warning in &draft.warnings {
        args.output.warn(warning);
    }
    args.output
        .result(|| printable(&said(&draft)), || json(&draft));
    Ok(())
}

/// What the command line can mend is its fault.
fn classified(error: SetupError) -> anyhow::Error {
    match error {
        SetupError::Value { .. } | SetupError::Exists { .. } | SetupError::NoGround { .. } => {
            Usage(error.to_string()).into()
        }
        other => other.into(),
    }
}

/// The next commands.
fn commands(path: &Path) -> [String; 3] {
    let file = match path == Path::new("pipeline.toml") {
        true => String::new(),
        false => format!(" {}", quoted(&path.display().to_string())),
    };
    [
        format!("dipir place{file}"),
        format!("dipir run{file} --draft"),
        format!("dipir run{file}"),
    ]
}

fn said(draft: &Draft) -> String {
    let document = &draft.document;
    let view = &document.view;
    let mut text = format!(
        "wrote {}\n  position: {}\n  direction: {}\n  field of view: {}\n",
        draft.path.display(),
        view.position_why,
        view.aim_why,
        view.fov_why
    );
    if let Some(points) = &document.points {
        text += &format!("  ground: {}\n", points.words);
    }
    if !document.views.is_empty() {
        let views = document.views.join(", ");
        text += &format!("  light: pictures of other directions tell it, too: {views}\n");
    }
    for object in &document.objects {
        let [x, y] = object.at_pixel;
        let place = match object.auto {
            true => "wherever it is free".into(),
            false => format!("at pixel {x}, {y}"),
        };
        let appears = match object.appearance(document.facts.size) {
            Some(words) if object.auto => format!("; at pixel {x}, {y} it {words}"),
            Some(words) => format!(", {words}"),
            None => String::new(),
        };
        text += &format!("  {}: {place}{appears}; {}\n", object.path, object.size_why);
    }
    let [place, look, whole] = commands(&draft.path);
    text + &format!(
        "next:\n  {place}    a page in the browser: put it where it belongs (dipir preview: the same as a PNG)\n  \
         {look}    a quick look\n  {whole}    the picture"
    )
}

fn json(draft: &Draft) -> Value {
    let document = &draft.document;
    let view = &document.view;
    let objects = document.objects.iter();
    json!({
        "file": json_path(&draft.path),
        "out": document.out,
        "camera": {
            "position": view.position.to_array(), "position_why": view.position_why,
            "direction_why": view.aim_why,
            "fov_deg": view.fov_deg, "fov_why": view.fov_why,
        },
        "views": document.views,
        "objects": objects.map(|o| json!({
            "path": o.path, "at_pixel": o.at_pixel, "appears_px": o.appears_px,
            "size_why": o.size_why,
        })).collect::<Vec<_>>(),
        "next": commands(&draft.path),
    })
}
