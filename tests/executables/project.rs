//! A small project in a folder of its own, and the executables run in it.
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use dipir_imaging::file::write_png;
use dipir_imaging::layers::Layers;
use dipir_imaging::raster::{DisplayImage, Raster};
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;
use serde_json::Value;
use tempfile::TempDir;

/// `dipir`.
pub const DIPIR: &str = env!("CARGO_BIN_EXE_dipir");
/// `dipir-scene`.
pub const SCENE: &str = env!("CARGO_BIN_EXE_dipir-scene");
/// `dipir-composite`.
pub const COMPOSITE: &str = env!("CARGO_BIN_EXE_dipir-composite");
/// `dipir-light`.
pub const OPTIMIZE: &str = env!("CARGO_BIN_EXE_dipir-light");
/// `dipir-optimize`, the earlier name of `dipir-light`.
pub const EARLIER: &str = env!("CARGO_BIN_EXE_dipir-optimize");
/// `dipir-tradeoff`.
pub const TRADEOFF: &str = env!("CARGO_BIN_EXE_dipir-tradeoff");
/// `dipir-evaluate`.
pub const EVALUATE: &str = env!("CARGO_BIN_EXE_dipir-evaluate");
/// `dipir-pretrain`.
pub const PRETRAIN: &str = env!("CARGO_BIN_EXE_dipir-pretrain");
/// `dipir-inspect`.
pub const INSPECT: &str = env!("CARGO_BIN_EXE_dipir-inspect");

/// Exif tags of fractions: seconds, the lens's f-number, its focal length in millimetres.
pub const EXPOSURE_TIME: u16 = 0x829a;
/// See there.
pub const F_NUMBER: u16 = 0x829d;
/// See there.
pub const FOCAL_LENGTH: u16 = 0x920a;
/// Exif tag of a whole number.
const ISO_SPEED: u16 = 0x8827;

/// A tetrahedron that stands on y = 0.
pub const OBJECT: &str = "v -0.6 0 0.5\nv 0.6 0 0.5\nv 0 0 -0.6\nv 0 1.1 0\n\
                          f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";

const PIPELINE: &str = r#"# A tetrahedron on a floor.
[scene]
background = "background.png"
class = "toy"

[[scene.objects]]
path = "object.obj"

[scene.camera]
position = [0.0, 1.2, 4.0]
look_at = [0.0, 0.4, 0.0]
fov_deg = 40.0

[scene.proxy]
plane = { point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }

[composite]
environment = "sky.exr"
target_error = 0.05
"#;

/// A folder with everything that the stages need.
pub struct Project {
    folder: TempDir,
}

/// What a run left behind.
#[derive(Debug)]
pub struct Run {
    /// Exit code; `None` if a signal ended it.
    pub code: Option<i32>,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

impl Project {
    /// A photo of 36 x 24 pixels, a tetrahedron, a sky with a sun.
    pub fn new() -> Self {
        let project = Self {
            folder: tempfile::tempdir().unwrap(),
        };
        let (width, height) = (36, 24);
        let pixels = (0..width * height)
            .map(|n| {
                let (x, y) = ((n % width) as f32 / 36.0, (n / width) as f32 / 24.0);
                Vec3::new(0.4 + 0.3 * x, 0.5 + 0.2 * y, 0.55)
            })
            .collect();
        let photo = DisplayImage(Raster::from_pixels(width, height, pixels));
        write_png(project.path("background.png"), &photo).unwrap();
        let mut texels = vec![Vec3::splat(0.4); 16 * 8];
        texels[2 * 16 + 5] = Vec3::splat(20.0);
        let sky = EnvironmentMap::new(16, 8, texels).unwrap();
        sky.write(project.path("sky.exr")).unwrap();
        project.write("object.obj", OBJECT);
        project.write("pipeline.toml", PIPELINE);
        project
    }

    /// A file of the project.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a file.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).unwrap();
    }

    /// Writes a photograph of one colour whose Exif data are these fractions, and an ISO speed of 100. Tags rise.
    pub fn write_jpeg(&self, name: &str, color: [u8; 3], exif: &[(u16, [u32; 2])]) {
        let picture = image::RgbImage::from_pixel(36, 24, image::Rgb(color));
        let mut encoded = std::io::Cursor::new(vec![]);
        picture
            .write_to(&mut encoded, image::ImageFormat::Jpeg)
            .unwrap();
        let encoded = encoded.into_inner();
        // A TIFF header, a directory that names another, and that.
        let mut bytes =
            b"Exif\0\0II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x1a\0\0\0\0\0\0\0".to_vec();
        let entries = exif.len() as u16 + 1;
        bytes.extend(entries.to_le_bytes());
        let mut entry = |tag: u16, kind: u16, value: u32| {
            bytes.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
            bytes.extend([1u32.to_le_bytes(), value.to_le_bytes()].concat());
        };
        let values = 0x1a + 2 + 12 * u32::from(entries) + 4;
        let mut all: Vec<_> = (exif.iter().enumerate())
            .map(|(i, (tag, _))| (*tag, 5, values + 8 * i as u32))
            .collect();
        all.push((ISO_SPEED, 3, 100));
        all.sort();
        for (tag, kind, value) in all {
            entry(tag, kind, value);
        }
        bytes.extend([0; 4]);
        bytes.extend(
            exif.iter()
                .flat_map(|(_, n)| n.map(u32::to_le_bytes).concat()),
        );
        let length = u16::try_from(bytes.len() + 2).unwrap().to_be_bytes();
        let all = [&encoded[..2], &[0xff, 0xe1], &length, &bytes, &encoded[2..]];
        self.write(name, all.concat());
    }

    /// How many pixels the objects cover in part, and what `look.json` says, of the composite in this folder of artifacts. Its
    /// layers give its picture.
    pub fn edges_and_look(&self, out: &str) -> (usize, Value) {
        let folder = format!("{out}/composite");
        let layers = Layers::read_exr(self.path(&format!("{folder}/composite.exr"))).unwrap();
        let alpha = layers.channel("object.A").unwrap().pixels();
        let [object, shadow, background, picture] =
            ["object", "shadow", "background", ""].map(|name| layers.rgb(name).unwrap());
        for (i, a) in alpha.iter().enumerate() {
            let behind = background.pixels()[i] * shadow.pixels()[i] * (1.0 - a);
            let (again, picture) = (behind + object.pixels()[i], picture.pixels()[i]);
            // Half precision has 11 bits, and rounds each layer once.
            let off = (again - picture).abs().max_element();
            assert!(off <= 2e-3 * picture.max_element().max(0.01), "{i} {off}");
        }
        let edges = alpha.iter().filter(|a| **a > 0.0 && **a < 1.0);
        let look = serde_json::from_slice(&self.read(&format!("{folder}/look.json"))).unwrap();
        (edges.count(), look)
    }

    /// Reads a file.
    pub fn read(&self, name: &str) -> Vec<u8> {
        fs::read(self.path(name)).unwrap()
    }

    /// A command in the project's folder, its output caught.
    pub fn command(&self, executable: &str, args: &[&str]) -> Command {
        let mut command = Command::new(executable);
        command
            .args(args)
            .current_dir(self.folder.path())
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        command
    }

    /// Runs an executable to its end.
    pub fn run(&self, executable: &str, args: &[&str]) -> Run {
        self.command(executable, args).output().unwrap().into()
    }

    /// Names in a folder of the project, sorted.
    pub fn names(&self, folder: &str) -> Vec<String> {
        let entries = fs::read_dir(self.path(folder)).unwrap();
        let names = entries.map(|e| e.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names
    }

    /// Runs `dipir-scene` and `dipir-composite`, which must succeed.
    pub fn run_both(&self, args: &[&str]) {
        self.run(SCENE, args).expect_success();
        self.run(COMPOSITE, args).expect_success();
    }

    /// Every file of a stage but its mark and `stage.json`, which holds times, with its bytes;
    /// names are relative to the stage's folder.
    pub fn artifacts(&self, stage: &str) -> Vec<(String, Vec<u8>)> {
        let mut files = Vec::new();
        collect(&self.path(stage), "", &mut files);
        files.retain(|(name, _)| name != "stage.json" && name != ".dipir");
        files.sort();
        files
    }
}

fn collect(folder: &Path, prefix: &str, files: &mut Vec<(String, Vec<u8>)>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = format!("{prefix}{}", path.file_name().unwrap().to_string_lossy());
        if path.is_dir() {
            collect(&path, &format!("{name}/"), files);
        } else {
            files.push((name, fs::read(&path).unwrap()));
        }
    }
}

impl From<Output> for Run {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

impl Run {
    /// Asserts exit code 0.
    #[track_caller]
    pub fn expect_success(&self) {
        assert_eq!(self.code, Some(0), "{}", self.stderr);
    }

    /// Asserts the exit code, an empty standard output and the whole of standard error.
    #[track_caller]
    pub fn expect_error(&self, code: i32, message: &str) {
        assert_eq!(self.stderr.trim_end(), message);
        assert_eq!((self.code, self.stdout.as_str()), (Some(code), ""));
    }
}
