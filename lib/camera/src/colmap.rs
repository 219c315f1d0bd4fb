//! COLMAP's sparse models, as text (`cameras.txt`, `images.txt`, `points3D.txt`) or binary (`.bin`).
//!
//! Images map world to camera in image axes. The world has no known up and scale.
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufRead, BufReader, Cursor, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::camera::{Camera, Lens, Pose, WorldUp};
use crate::distortion::Distortion;
use crate::error::CameraError;

const FORMAT: &str = "COLMAP";

/// Cameras by the names of their images, and the points of the scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Model {
    /// In the order of the file.
    pub images: Vec<(String, Camera)>,
    /// World positions.
    pub points: Vec<DVec3>,
}

/// Where the files of a model are.
#[derive(Clone, Debug, PartialEq)]
pub struct Files {
    folder: PathBuf,
    extension: &'static str,
    /// Folders of the project's models, in their order.
    models: Vec<PathBuf>,
}

impl Files {
    /// Of the model that `path` stands for: its folder, a project's, whose models are in `sparse` or in its numbered
    /// folders, or one of the model's files. `None` if `path` is another file.
    pub fn at(path: &Path) -> Option<Self> {
        if path.is_dir() {
            return Some(Self::in_folder(path));
        }
        let stem = path.file_stem()?.to_str()?;
        let kind = path.extension()?.to_str()?;
        let extension = EXTENSIONS.into_iter().find(|e| *e == kind)?;
        STEMS.contains(&stem).then(|| Self {
            folder: path.parent().unwrap_or(Path::new("")).into(),
            extension,
            models: Vec::new(),
        })
    }

    fn in_folder(path: &Path) -> Self {
        let sparse = path.join("sparse");
        let own = [path, &sparse].into_iter().find(|f| has_model(f));
        let models = match own {
            Some(folder) => vec![folder.to_owned()],
            None => [path, &sparse].into_iter().flat_map(numbered).collect(),
        };
        let folder = models.first().cloned().unwrap_or(path.into());
        Self {
            extension: match is_binary(&folder) {
                true => "bin",
                false => "txt",
            },
            folder,
            models,
        }
    }

    /// The file of `cameras`, `images` or `points3D`.
    pub fn part(&self, stem: &str) -> PathBuf {
        self.folder.join(format!("{stem}.{}", self.extension))
    }

    /// Which model was taken, if there are several, and how another is.
    pub fn choice(&self) -> Option<String> {
        let [first, second, ..] = &self.models[..] else {
            return None;
        };
        Some(format!(
            "COLMAP's project has {} models, and the one in {first:?} is read; for another write its folder, for instance {second:?}",
            self.models.len()
        ))
    }

    fn bytes(&self, stem: &str) -> Result<Vec<u8>, CameraError> {
        let path = self.part(stem);
        dipir_files::read(&path).map_err(|source| CameraError::Read { path, source })
    }

    /// The file of the images, opened: most of it is 2D points, which are passed over.
    fn images(&self) -> Result<BufReader<File>, CameraError> {
        let path = self.part("images");
        let opened = dipir_files::open(&path);
        let opened = opened.map_err(|source| CameraError::Read { path, source })?;
        Ok(BufReader::new(opened))
    }
}

const EXTENSIONS: [&str; 2] = ["bin", "txt"];
const STEMS: [&str; 3] = ["cameras", "images", "points3D"];

fn is_binary(folder: &Path) -> bool {
    folder.join("cameras.bin").exists()
}

fn has_model(folder: &Path) -> bool {
    is_binary(folder) || folder.join("cameras.txt").exists()
}

/// The models in folders of `parent` whose names are numbers, in their order.
fn numbered(parent: &Path) -> Vec<PathBuf> {
    let entries = parent.read_dir().into_iter().flatten().flatten();
    let number = |path: PathBuf| Some((path.file_name()?.to_str()?.parse::<u32>().ok()?, path));
    let all = entries.filter_map(|entry| number(entry.path()));
    let mut all: Vec<_> = all.filter(|(_, path)| has_model(path)).collect();
    all.sort();
    all.into_iter().map(|(_, path)| path).collect()
}

/// The camera of a model that `choose` takes by the names of all images, in the file's order. `up` is the axis of the
/// model's world that points up.
///
/// # Errors
/// If a file is missing or cut short, `choose` takes none, or the camera is of a model that is not known.
pub fn read_camera(
    files: &Files,
    up: WorldUp,
    choose: impl FnOnce(&[&str]) -> Result<usize, CameraError>,
) -> Result<Camera, CameraError> {
    let file = Contents::of_cameras(files)?;
    let names: Vec<&str> = file.images.iter().map(|i| i.name.as_str()).collect();
    file.camera(&file.images[choose(&names)?], up)
}

/// The cameras of a model's pictures, without those that cannot be read. Errors as [`read_camera`].
pub(crate) fn pictures(files: &Files, up: WorldUp) -> Result<Vec<(String, Camera)>, CameraError> {
    let file = Contents::of_cameras(files)?;
    let named = |i: &Image| Some((i.name.clone(), file.camera(i, up).ok()?));
    Ok(file.images.iter().filter_map(named).collect())
}

/// The points of `points3D.txt` or, if `binary`, `points3D.bin`. Errors as [`read_camera`].
pub fn read_points(points: &[u8], binary: bool, up: WorldUp) -> Result<Vec<DVec3>, CameraError> {
    const NONE: [u8; 8] = [0; 8];
    match binary {
        true => Ok(read_binary(&NONE, &NONE, points, up)?.points),
        false => Ok(read_text("", "", text(points)?, up)?.points),
    }
}

fn text(bytes: &[u8]) -> Result<&str, CameraError> {
    dipir_files::refuse_utf16(bytes).map_err(failed)?;
    let bytes = dipir_files::without_byte_order_mark(bytes);
    std::str::from_utf8(bytes).map_err(|_| CameraError::new(FORMAT, "it is not UTF-8"))
}

fn failed(error: io::Error) -> CameraError {
    CameraError::new(FORMAT, error.to_string())
}

/// Reads the contents of the text files; `points` may be empty. Errors as [`read_camera`].
pub fn read_text(
    cameras: &str,
    images: &str,
    points: &str,
    up: WorldUp,
) -> Result<Model, CameraError> {
    Contents::text(cameras, images.as_bytes(), points)?.model(up)
}

/// Reads the contents of the binary files; `points` may be empty. Errors as [`read_camera`].
pub fn read_binary(
    cameras: &[u8],
    images: &[u8],
    points: &[u8],
    up: WorldUp,
) -> Result<Model, CameraError> {
    Contents::binary(cameras, Cursor::new(images), points)?.model(up)
}

/// What the files of a model say. Lenses and poses are unchecked, so that one that cannot be read keeps no other from
/// being read.
#[derive(Default)]
struct Contents {
    lenses: BTreeMap<u32, Parameters>,
    images: Vec<Image>,
    points: Vec<DVec3>,
    /// The model of a camera with an unknown number of parameters, behind which no further camera is found.
    unknown_model: Option<u32>,
}

/// Of a lens.
struct Parameters {
    model: String,
    /// Of the image, pixels.
    size: [f64; 2],
    numbers: Vec<f64>,
}

struct Image {
    name: String,
    /// World to camera: quaternion w x y z, and translation.
    turn: [f64; 4],
    shift: DVec3,
    lens: u32,
}

impl Contents {
    /// Without points.
    fn of_cameras(files: &Files) -> Result<Self, CameraError> {
        let (cameras, mut images) = (files.bytes("cameras")?, files.images()?);
        if files.extension == "bin" {
            return Self::binary(&cameras, images, &[]);
        }
        let head = images.fill_buf().map_err(failed)?;
        dipir_files::refuse_utf16(head).map_err(failed)?;
        let mark = head.len() - dipir_files::without_byte_order_mark(head).len();
        images.consume(mark);
        Self::text(text(&cameras)?, images, "")
    }

    fn text(cameras: &str, images: impl BufRead, points: &str) -> Result<Self, CameraError> {
        let wrong = |what: &str, line: &str| {
            let line: String = line.chars().take(60).collect();
            CameraError::new(
                FORMAT,
                format!("{what} \"{}\" cannot be read", line.escape_debug()),
            )
        };
        let mut file = Self::default();
        for line in records(cameras).filter(|l| !l.is_empty()) {
            let words: Vec<&str> = line.split_whitespace().collect();
            let numbers: Option<Vec<f64>> = words.iter().skip(2).map(|w| w.parse().ok()).collect();
            let id = words.first().and_then(|w| w.parse::<u32>().ok());
            let (Some(id), Some(model), Some(numbers)) = (id, words.get(1), numbers) else {
                return Err(wrong("the camera", line));
            };
            let [w, h, parameters @ ..] = &numbers[..] else {
                return Err(wrong("the camera", line));
            };
            let parameters = Parameters {
                model: model.to_string(),
                size: [*w, *h],
                numbers: parameters.to_vec(),
            };
            file.lenses.insert(id, parameters);
        }
        // Each image is a line followed by one of its points, which may be empty; further empty lines mean nothing.
        let mut lines = Lines(images, String::new());
        while let Some(line) = lines.next()? {
            if line.is_empty() {
                continue;
            }
            let words: Vec<&str> = line.splitn(10, char::is_whitespace).collect();
            let numbers: Option<Vec<f64>> = words
                .iter()
                .skip(1)
                .take(7)
                .map(|w| w.parse().ok())
                .collect();
            let id = words.get(8).and_then(|w| w.parse::<u32>().ok());
            let (Some(numbers), Some(id), Some(name)) = (numbers, id, words.get(9)) else {
                return Err(wrong("the image", line));
            };
            let [q0, q1, q2, q3, x, y, z] = numbers[..] else {
                return Err(wrong("the image", line));
            };
            file.images.push(Image {
                name: name.trim().to_string(),
                turn: [q0, q1, q2, q3],
                shift: DVec3::new(x, y, z),
                lens: id,
            });
            lines.next()?;
        }
        for line in records(points).filter(|l| !l.is_empty()) {
            let numbers = line.split_whitespace().skip(1).take(3);
            let numbers: Option<Vec<f64>> = numbers.map(|w| w.parse().ok()).collect();
            let Some([x, y, z]) = numbers.as_deref() else {
                return Err(wrong("the point", line));
            };
            file.points.push(DVec3::new(*x, *y, *z));
        }
        Ok(file)
    }

    fn binary(
        cameras: &[u8],
        images: impl BufRead + Seek,
        points: &[u8],
    ) -> Result<Self, CameraError> {
        let mut file = Self::default();
        let mut at = Bytes::of(Cursor::new(cameras))?;
        for _ in 0..at.u64()? {
            let (id, kind) = (at.u32()?, at.u32()?);
            let size = [at.u64()? as f64, at.u64()? as f64];
            let mut models = MODELS.iter().chain(&UNREAD);
            let Some(&(_, model, count)) = models.find(|m| m.0 == kind) else {
                file.unknown_model = Some(kind);
                break;
            };
            let numbers = (0..count).map(|_| at.f64()).collect::<Result<_, _>>()?;
            let model = model.to_string();
            let parameters = Parameters {
                model,
                size,
                numbers,
            };
            file.lenses.insert(id, parameters);
        }
        let mut at = Bytes::of(images)?;
        for _ in 0..at.u64()? {
            at.u32()?;
            let turn = [at.f64()?, at.f64()?, at.f64()?, at.f64()?];
            let shift = DVec3::new(at.f64()?, at.f64()?, at.f64()?);
            let lens = at.u32()?;
            let name = at.text()?;
            let seen = at.u64()?;
            at.skip(seen, 24)?;
            file.images.push(Image {
                name,
                turn,
                shift,
                lens,
            });
        }
        if !points.is_empty() {
            let mut at = Bytes::of(Cursor::new(points))?;
            for _ in 0..at.u64()? {
                at.u64()?;
                let point = DVec3::new(at.f64()?, at.f64()?, at.f64()?);
                at.skip(1, 3 + 8)?;
                let track = at.u64()?;
                at.skip(track, 8)?;
                file.points.push(point);
            }
        }
        Ok(file)
    }

    fn model(self, up: WorldUp) -> Result<Model, CameraError> {
        let images = self.images.iter();
        let images = images.map(|i| Ok((i.name.clone(), self.camera(i, up)?)));
        let images = images.collect::<Result<_, CameraError>>()?;
        let points = self.points.into_iter().map(|p| up.to_ours() * p);
        Ok(Model {
            images,
            points: points.collect(),
        })
    }

    fn camera(&self, image: &Image, up: WorldUp) -> Result<Camera, CameraError> {
        let wrong = |what: &str| CameraError::new(FORMAT, what);
        let parameters = self.lenses.get(&image.lens);
        if let (None, Some(kind)) = (parameters, self.unknown_model) {
            return Err(unknown(&kind.to_string()));
        }
        let Parameters {
            model,
            size,
            numbers,
        } = parameters.ok_or_else(|| wrong("an image names a camera that is not there"))?;
        let [w, x, y, z] = image.turn;
        let quaternion = DQuat::from_xyzw(x, y, z, w);
        let length = quaternion.length();
        let pose = match length > 1e-6 && length.is_finite() {
            true => Pose::from_world_to_image(DMat3::from_quat(quaternion / length), image.shift),
            false => None,
        };
        let pose = pose.ok_or_else(|| wrong("an image has no rotation"))?;
        Ok(Camera {
            pose: pose.in_our_world(up),
            lens: lens(model, *size, numbers)?,
        })
    }
}

/// Lines that are no comments.
fn records(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .map(str::trim)
        .filter(|line| !line.starts_with('#'))
}

/// As [`records`], of what is read line by line; the line last read is kept.
struct Lines<R>(R, String);

impl<R: BufRead> Lines<R> {
    fn next(&mut self) -> Result<Option<&str>, CameraError> {
        loop {
            self.1.clear();
            let read = self.0.read_line(&mut self.1);
            let read = read.map_err(|e| match e.kind() {
                io::ErrorKind::InvalidData => CameraError::new(FORMAT, "it is not UTF-8"),
                _ => failed(e),
            })?;
            if read == 0 {
                return Ok(None);
            }
            if !self.1.trim_start().starts_with('#') {
                return Ok(Some(self.1.trim()));
            }
        }
    }
}

/// Little-endian values from the front of a source, of which so many bytes are left.
struct Bytes<R> {
    source: R,
    left: u64,
}

impl<R: BufRead + Seek> Bytes<R> {
    fn of(mut source: R) -> Result<Self, CameraError> {
        let left = source.seek(SeekFrom::End(0)).map_err(failed)?;
        source.rewind().map_err(failed)?;
        Ok(Self { source, left })
    }

    fn take(&mut self, count: u64) -> Result<(), CameraError> {
        let left = self.left.checked_sub(count);
        self.left = left.ok_or_else(|| CameraError::new(FORMAT, "it is cut short"))?;
        Ok(())
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], CameraError> {
        self.take(N as u64)?;
        let mut out = [0; N];
        self.source.read_exact(&mut out).map_err(failed)?;
        Ok(out)
    }

    fn u32(&mut self) -> Result<u32, CameraError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<u64, CameraError> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    fn f64(&mut self) -> Result<f64, CameraError> {
        Ok(f64::from_le_bytes(self.array()?))
    }

    /// Up to a byte 0.
    fn text(&mut self) -> Result<String, CameraError> {
        let mut text = Vec::new();
        let read = self.source.read_until(0, &mut text).map_err(failed)?;
        self.take(read as u64)?;
        match text.pop() {
            Some(0) => Ok(String::from_utf8_lossy(&text).into_owned()),
            _ => Err(CameraError::new(FORMAT, "it is cut short")),
        }
    }

    fn skip(&mut self, count: u64, size: u64) -> Result<(), CameraError> {
        let bytes = count.saturating_mul(size);
        self.take(bytes)?;
        let bytes = i64::try_from(bytes).unwrap_or(i64::MAX);
        self.source.seek_relative(bytes).map_err(failed)
    }
}

/// Number, name and count of parameters of the models that are read.
const MODELS: [(u32, &str, usize); 9] = [
    (0, "SIMPLE_PINHOLE", 3),
    (1, "PINHOLE", 4),
    (2, "SIMPLE_RADIAL", 4),
    (3, "RADIAL", 5),
    (4, "OPENCV", 8),
    (5, "OPENCV_FISHEYE", 8),
    (6, "FULL_OPENCV", 12),
    (8, "SIMPLE_RADIAL_FISHEYE", 4),
    (9, "RADIAL_FISHEYE", 5),
];

/// Those that are only passed over, of which the count tells where the next camera begins.
const UNREAD: [(u32, &str, usize); 3] = [
    (7, "FOV", 5),
    (10, "THIN_PRISM_FISHEYE", 12),
    (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
];

fn unknown(model: &str) -> CameraError {
    let names: Vec<&str> = MODELS.iter().map(|m| m.1).collect();
    let detail = format!(
        "its camera model is {}; accepted: {}",
        model.escape_debug(),
        names.join(", ")
    );
    let remedy = "undistort the images with `colmap image_undistorter`";
    CameraError::with_remedy(FORMAT, detail, remedy)
}

fn lens(model: &str, size: [f64; 2], p: &[f64]) -> Result<Lens, CameraError> {
    let Some((_, _, count)) = MODELS.iter().find(|m| m.1 == model) else {
        return Err(unknown(model));
    };
    if p.len() != *count {
        let detail = format!("{model} has {} parameters, and needs {count}", p.len());
        return Err(CameraError::new(FORMAT, detail));
    }
    // One focal length, or two.
    let single = matches!(*count, 3 | 5) || model.starts_with("SIMPLE");
    let (focal, rest) = match single {
        true => (DVec2::splat(p[0]), &p[1..]),
        false => (DVec2::new(p[0], p[1]), &p[2..]),
    };
    let (principal_px, c) = (DVec2::new(rest[0], rest[1]), &rest[2..]);
    let k = |i: usize| c.get(i).copied().unwrap_or(0.0);
    let distortion = match model {
        "SIMPLE_PINHOLE" | "PINHOLE" => Some(Distortion::NONE),
        "SIMPLE_RADIAL" | "RADIAL" => {
            Distortion::brown_conrady([k(0), k(1), 0.0, 0.0], [0.0; 3], [0.0; 2])
        }
        "OPENCV" | "FULL_OPENCV" => {
            Distortion::brown_conrady([k(0), k(1), k(4), 0.0], [k(5), k(6), k(7)], [k(2), k(3)])
        }
        _ => Distortion::kannala_brandt([k(0), k(1), k(2), k(3)]),
    };
    let distortion =
        distortion.ok_or_else(|| CameraError::new(FORMAT, "its distortion is not finite"))?;
    let lens = Lens {
        principal_px,
        distortion,
        ..Lens::pinhole(size, focal)
    };
    lens.check(FORMAT)?;
    Ok(lens)
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::io::Read;

    use super::*;

    /// Counts what is read.
    struct Counted<'a>(Cursor<&'a [u8]>, &'a Cell<usize>);

    impl Read for Counted<'_> {
        fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
            let read = self.0.read(into)?;
            self.1.set(self.1.get() + read);
            Ok(read)
        }
    }

    impl Seek for Counted<'_> {
        fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
            self.0.seek(to)
        }
    }

    #[test]
    fn points_of_images_are_passed_over_unread() {
        const SEEN: usize = 5000;
        let mut bytes = 3u64.to_le_bytes().to_vec();
        for k in 0..3u32 {
            bytes.extend([0; 4]);
            bytes.extend(
                [1.0f64, 0.0, 0.0, 0.0, 0.0, 0.0, f64::from(k)]
                    .map(f64::to_le_bytes)
                    .concat(),
            );
            bytes.extend(1u32.to_le_bytes());
            bytes.extend(format!("{k}.png\0").bytes());
            bytes.extend((SEEN as u64).to_le_bytes());
            bytes.extend([0; SEEN * 24]);
        }
        let read = Cell::new(0);
        let of = |bytes| {
            let images = BufReader::new(Counted(Cursor::new(bytes), &read));
            Contents::binary(&[0; 8], images, &[])
        };
        let images = of(&bytes).unwrap().images;
        let found: Vec<_> = images
            .iter()
            .map(|i| (i.name.as_str(), i.shift.z))
            .collect();
        assert_eq!(found, [("0.png", 0.0), ("1.png", 1.0), ("2.png", 2.0)]);
        assert!(read.get() < bytes.len() / 10, "{} bytes", read.get());
        assert!(of(&bytes[..bytes.len() - 1]).is_err(), "cut short");
    }
}
