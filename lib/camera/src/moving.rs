//! The camera of a glTF file at a frame of a shot.
//!
//! An animation has keys at times, in seconds. Exporters that write a key for each frame, as Blender does unless it is told
//! otherwise, write the number of the frame over the rate, `k / fps`, or count from the first frame. So the rate is that of
//! the keys, and the numbers in the names of pictures are those of the keys, or both begin together.
use std::collections::btree_map::{BTreeMap, Entry};
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use glam::{DMat4, DQuat, DVec4};
use serde::Deserialize;

use crate::buffers::Buffers;
use crate::camera::{Camera, Lens};
use crate::error::CameraError;
use crate::file::{self, Wanted, Which};
use crate::gltf::{self, Channel, FORMAT, File, Seat};
use crate::track::{Course, Track};

/// Most keys of a camera and what it hangs from: a channel each of three has those of four hours.
const MOST_KEYS: usize = 1_000_000;
/// Rates that shots have, frames a second. Keys that are farther apart were not written for each frame.
const SLOWEST: f64 = 5.0;
const FASTEST: f64 = 1000.0;
/// How far a key may be from its frame, frames.
const OFF: f64 = 0.05;

/// What [`Motion`] changes of a node.
const MOVES: [&str; 3] = ["scale", "rotation", "translation"];

/// How a camera moves.
struct Motion {
    lens: Lens,
    /// Its node and those above it, from below.
    joints: Vec<Joint>,
}

/// A node, and what of it changes, as [`MOVES`] has it.
struct Joint {
    rest: DMat4,
    /// Where something changes.
    parts: Option<[DVec4; 3]>,
    tracks: [Option<Track>; 3],
}

/// The frames of a camera that moves.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Frames {
    /// Times of all keys, seconds, increasing.
    keys: Vec<f64>,
    /// Frames a second.
    rate: f64,
    /// The frames of the first and the last key, by the number of seconds times the rate.
    first: i64,
    last: i64,
}

/// The frame of a camera that a picture shows.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Shown {
    /// Seconds of the file times frames a second.
    pub frame: u32,
    /// What was assumed to find it, a sentence that is the same for all pictures of a shot.
    pub assumed: String,
    /// Whether pictures have other numbers than frames, or there are more of them.
    pub is_doubtful: bool,
}

#[derive(Deserialize)]
struct Sampler {
    input: usize,
    output: usize,
    #[serde(default)]
    interpolation: Option<String>,
}

/// The wanted camera of a glTF file in its own world. Its buffers may be in `folder`.
///
/// # Errors
/// On a document or keys that are damaged, without a camera or a frame that is wanted.
pub fn read(bytes: &[u8], folder: Option<&Path>, wanted: &Wanted) -> Result<Camera, CameraError> {
    let (motion, at) = found(bytes, folder, wanted)?;
    motion.camera(at.map_or(0.0, |(frames, n)| frames.time_s(n)))
}

/// Cameras at the frames before and after the one that is wanted, and by how many frames they are later; none where it stands
/// still, or before the first and after the last frame.
pub(crate) fn beside(
    bytes: &[u8],
    folder: Option<&Path>,
    wanted: &Wanted,
) -> Result<Vec<(i64, Camera)>, CameraError> {
    let (motion, Some((frames, own))) = found(bytes, folder, wanted)? else {
        return Ok(Vec::new());
    };
    let own_frames = frames.first..=frames.last;
    // Beyond them it stands still.
    let is_there = |n: &i64| own_frames.contains(&(own + n)) || !own_frames.contains(&own);
    let beside = [-1, 1].into_iter().filter(is_there);
    let camera = |n: i64| Ok((n, motion.camera(frames.time_s(own + n))?));
    beside.map(camera).collect()
}

/// A frame that is wanted before the first or after the last one, as a sentence.
pub(crate) fn beyond(bytes: &[u8], folder: Option<&Path>, wanted: &Wanted) -> Option<String> {
    let (_, at) = found(bytes, folder, wanted).ok()?;
    let (frames, n) = at?;
    let nearest = n.clamp(frames.first, frames.last);
    (n != nearest).then(|| {
        let words = frames.words();
        format!("the camera moves, with {words}: in frame {n} it stands as in frame {nearest}")
    })
}

/// How the wanted camera moves, and its frame; `None` for one that stands still.
fn found(
    bytes: &[u8],
    folder: Option<&Path>,
    wanted: &Wanted,
) -> Result<(Motion, Option<(Frames, i64)>), CameraError> {
    let file = File::parse(bytes)?;
    let cameras = file.cameras(wanted.size)?;
    let is_one = cameras.len() == 1;
    let which = match wanted.which {
        Which::Frame(name, _) => Which::Name(name),
        // Of one camera it may be a frame.
        Which::Number(_) if is_one => Which::Number(0),
        which => which,
    };
    let seat = file::by_names(cameras, &Wanted { which, ..*wanted }, FORMAT)??;
    let motion = Motion::of(&file, &seat, folder)?;
    let Some(frames) = motion.frames()? else {
        return match wanted.which {
            Which::Frame(name, n) => Err(CameraError::with_remedy(
                FORMAT,
                format!("its camera {name:?} stands still, and has no frame {n}"),
                "leave the number out",
            )),
            Which::Number(_) if is_one => {
                file::only(wanted, FORMAT)?;
                Ok((motion, None))
            }
            _ => Ok((motion, None)),
        };
    };
    let number = match wanted.which {
        Which::Frame(_, n) => n,
        Which::Number(n) if is_one => n,
        Which::Photo(path) => frames.shown(path, &mut Numbers::new())?.frame,
        Which::Number(_) | Which::Name(_) => {
            let detail = format!("the camera moves, with {}", frames.words());
            let remedy = "say which by its name and the number of the frame, for instance image = \"Camera\" with frame = 1 (dipir init: --camera-image, --camera-frame)";
            return Err(CameraError::with_remedy(FORMAT, detail, remedy));
        }
    };
    Ok((motion, Some((frames, i64::from(number)))))
}

/// The frame that each of `photos` shows of the camera with this `name` or, without one, of the one that [`Which::Photo`]
/// means; `None` if it stands still.
pub(crate) fn shown(
    bytes: &[u8],
    folder: Option<&Path>,
    name: Option<&str>,
    photos: &[PathBuf],
) -> Result<Vec<Option<Shown>>, CameraError> {
    let file = File::parse(bytes)?;
    let (mut known, mut numbers) = (BTreeMap::new(), Numbers::new());
    let mut of = |photo: &PathBuf| {
        let wanted = Wanted {
            // Of any picture, as its frame does not depend on it.
            size: [1e3, 1e3],
            which: name.map_or(Which::Photo(photo), Which::Name),
            up: None,
            fov_deg: None,
            turns: None,
        };
        let seat = file::by_names(file.cameras(wanted.size)?, &wanted, FORMAT)??;
        let frames: &Option<Frames> = match known.entry(seat.node) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(Motion::of(&file, &seat, folder)?.frames()?),
        };
        let shown = |frames: &Frames| frames.shown(photo, &mut numbers);
        frames.as_ref().map(shown).transpose()
    };
    photos.iter().map(&mut of).collect()
}

impl Motion {
    fn of(file: &File, seat: &Seat, folder: Option<&Path>) -> Result<Self, CameraError> {
        let path = file.above(seat.node)?;
        let mut tracks = tracks(file, seat, &path, folder)?;
        let joint = |&node: &usize| {
            let own = &file.document.nodes[node];
            let tracks: [Option<Track>; 3] =
                std::array::from_fn(|part| tracks.remove(&(node, part)));
            let parts = tracks.iter().any(Option::is_some).then(|| {
                let (scale, rotation, translation) = own.parts();
                [scale.extend(0.0), rotation.into(), translation.extend(0.0)]
            });
            Joint {
                rest: own.matrix(),
                parts,
                tracks,
            }
        };
        Ok(Self {
            lens: seat.lens,
            joints: path.iter().map(joint).collect(),
        })
    }

    /// The camera at this time, seconds.
    fn camera(&self, time_s: f64) -> Result<Camera, CameraError> {
        let pose = gltf::pose(self.joints.iter().map(|joint| joint.matrix(time_s)))?;
        let lens = self.lens;
        Ok(Camera { pose, lens })
    }

    /// Its frames; `None` if it stands still.
    fn frames(&self) -> Result<Option<Frames>, CameraError> {
        let tracks = self.joints.iter().flat_map(|joint| &joint.tracks).flatten();
        let tracks = tracks.filter(|track| !track.is_constant());
        let mut keys: Vec<f64> = tracks.flat_map(Track::times).copied().collect();
        keys.sort_by(f64::total_cmp);
        // Of the same key, up to rounding.
        keys.dedup_by(|b, a| *b - *a < 0.1 / FASTEST);
        let frames = (!keys.is_empty()).then(|| Frames::of(keys));
        frames.transpose()
    }
}

impl Joint {
    fn matrix(&self, time_s: f64) -> DMat4 {
        let Some(rest) = self.parts else {
            return self.rest;
        };
        let part = |k: usize| self.tracks[k].as_ref().map_or(rest[k], |t| t.at(time_s));
        let [scale, rotation, translation] = [0, 1, 2].map(part);
        DMat4::from_scale_rotation_translation(
            scale.truncate(),
            DQuat::from_vec4(rotation),
            translation.truncate(),
        )
    }
}

/// What changes of these nodes, by node and part.
fn tracks(
    file: &File,
    seat: &Seat,
    path: &[usize],
    folder: Option<&Path>,
) -> Result<BTreeMap<(usize, usize), Track>, CameraError> {
    let buffers = Buffers::new(file, folder);
    let mut tracks = BTreeMap::new();
    let mut keys = 0;
    for animation in &file.document.animations {
        for channel in &animation.channels {
            let Some((node, part)) = changed(channel, seat)? else {
                continue;
            };
            if !path.contains(&node) {
                continue;
            }
            let name = &file.document.nodes[node].name;
            let of = |what: String| {
                let part = MOVES[part];
                CameraError::new(
                    FORMAT,
                    format!("the {part} of its node {name:?} has {what}"),
                )
            };
            if tracks.contains_key(&(node, part)) {
                let part = MOVES[part];
                let detail = format!("two animations have a {part} of its node {name:?}");
                let remedy = "export the one of the shot alone (in Blender: Animation Mode, Active actions merged)";
                return Err(CameraError::with_remedy(FORMAT, detail, remedy));
            }
            let index = channel.sampler.as_u64().map(|i| i as usize);
            let sampler = index.and_then(|i| animation.samplers.get(i));
            let sampler = sampler.ok_or_else(|| of("no keys: its sampler is missing".into()))?;
            let sampler = Sampler::deserialize(sampler)
                .map_err(|e| of(format!("a sampler that cannot be read: {e}")))?;
            let course = match sampler.interpolation.as_deref() {
                None | Some("LINEAR") => Course::Linear,
                Some("STEP") => Course::Step,
                Some("CUBICSPLINE") => Course::CubicSpline,
                Some(other) => return Err(of(format!("the interpolation {other:?}"))),
            };
            let [times, values] = [sampler.input, sampler.output].map(|i| buffers.count(i));
            keys += times?.max(values? / 3).min(MOST_KEYS + 1);
            if keys > MOST_KEYS {
                let detail = format!("its camera has more than {MOST_KEYS} keys");
                let remedy = "export the frames of the shot alone, and a key for each";
                return Err(CameraError::with_remedy(FORMAT, detail, remedy));
            }
            let kind = if MOVES[part] == "rotation" {
                "VEC4"
            } else {
                "VEC3"
            };
            let times = buffers.vectors(sampler.input, "SCALAR")?;
            let times = times.iter().map(|t| t.x).collect();
            let values = buffers.vectors(sampler.output, kind)?;
            let track = Track::new(times, values, course, kind == "VEC4").map_err(of)?;
            tracks.insert((node, part), track);
        }
    }
    Ok(tracks)
}

/// The node that a channel changes, and which part of it. An error if it changes the camera's lens.
fn changed(channel: &Channel, seat: &Seat) -> Result<Option<(usize, usize)>, CameraError> {
    let target = &channel.target;
    // KHR_animation_pointer names a value of the document: /nodes/3/translation.
    let pointer = &target.extensions["KHR_animation_pointer"]["pointer"];
    let steps: Vec<&str> = pointer.as_str().unwrap_or_default().split('/').collect();
    let (node, path) = match steps[..] {
        [
            "",
            "cameras",
            index,
            "perspective",
            what @ ("yfov" | "aspectRatio"),
        ] if index.parse() == Ok(seat.camera) => {
            return Err(CameraError::with_remedy(
                FORMAT,
                format!(
                    "its camera zooms: an animation changes {what} (KHR_animation_pointer), which is not read"
                ),
                "export .chan or transforms.json",
            ));
        }
        ["", "nodes", node, path] => (node.parse().ok(), path),
        _ => (target.node, target.path.as_str()),
    };
    let part = MOVES.iter().position(|moves| *moves == path);
    Ok(node.zip(part))
}

impl Frames {
    /// Of the times of all keys, at least one.
    fn of(keys: Vec<f64>) -> Result<Self, CameraError> {
        let wrong = |what: String| {
            CameraError::with_remedy(
                FORMAT,
                format!("the frames of its camera cannot be told: {what}"),
                "export it with a key for each frame (in Blender: Animation, Always Sample Animations, Sampling Rate 1; \
                 elsewhere bake it), or as .chan",
            )
        };
        let gaps = || keys.windows(2).map(|pair| pair[1] - pair[0]);
        let least = gaps().fold(f64::INFINITY, f64::min);
        if !(SLOWEST..=FASTEST).contains(&least.recip().round()) {
            return Err(wrong(format!("its keys are {} s apart", rounded(least))));
        }
        let steps: Vec<f64> = gaps().map(|gap| (gap / least).round()).collect();
        let (start, end) = (keys[0], keys[keys.len() - 1]);
        // All keys together, as each is rounded to single precision.
        let rate = nominal(steps.iter().sum::<f64>() / (end - start), start, end);
        let is_off = |time: &&f64| {
            let frame = **time * rate;
            (frame - frame.round()).abs() > OFF
        };
        if let Some(time) = keys.iter().find(is_off) {
            let least = rounded(1.0 / rate);
            return Err(wrong(format!(
                "keys are {least} s apart, but the one at {time} s is no multiple of that"
            )));
        }
        // Frames between which others lie without keys.
        if 2 * steps.iter().filter(|n| **n == 1.0).count() < steps.len() {
            return Err(wrong("most frames have no key".into()));
        }
        let [first, last] = [start, end].map(|time| (time * rate).round() as i64);
        Ok(Self {
            keys,
            rate,
            first,
            last,
        })
    }

    /// The time of a frame, seconds: that of its key, where it has one.
    fn time_s(&self, frame: i64) -> f64 {
        let time = frame as f64 / self.rate;
        let from = self
            .keys
            .partition_point(|key| *key < time - OFF / self.rate);
        let key = self.keys.get(from).copied();
        let is_its = |key: &f64| (key - time).abs() <= 2.0 * OFF / self.rate;
        key.filter(is_its).unwrap_or(time)
    }

    fn words(&self) -> String {
        let rate = rounded(self.rate);
        format!("frames {} to {} at {rate} a second", self.first, self.last)
    }

    /// The frame that `photo` shows, which other pictures of its folder tell, too; `known` are those of earlier photos.
    fn shown(&self, photo: &Path, known: &mut Numbers) -> Result<Shown, CameraError> {
        let name = photo.file_name().unwrap_or_default();
        let Some(number) = file::number(photo) else {
            let detail = format!(
                "the camera moves, with {}, and {name:?} does not end in the number of one",
                self.words()
            );
            let remedy = "name the picture by it (plate.1001.png), or say which, for instance frame = 1 (dipir init: --camera-frame 1)";
            return Err(CameraError::with_remedy(FORMAT, detail, remedy));
        };
        let [low, high] = numbers_beside(photo, number, known);
        // Either has all of the other: they are counted alike.
        let holds = |a: [i64; 2], b: [i64; 2]| a[0] <= b[0] && b[1] <= a[1];
        let (own, all) = ([self.first, self.last], [low, high]);
        let is_alike = holds(own, all) || holds(all, own);
        let frame = match is_alike {
            true => number,
            false => number.saturating_sub(low).saturating_add(self.first),
        };
        let shift = frame.saturating_sub(number);
        let mut assumed = format!(
            "the camera moves, with {}, and the pictures have the numbers {low} to {high}: ",
            self.words()
        );
        assumed += &match is_alike {
            true => "these are taken to be the frames' numbers".to_string(),
            false => format!(
                "picture {low} is taken to be frame {}; if it is not, write the frame of the photograph, for instance \
                 frame = {}, into [scene.camera]",
                self.first, self.first
            ),
        };
        let is_beyond = !holds(own, all.map(|n| n.saturating_add(shift)));
        if is_beyond {
            assumed += "; pictures beyond its frames have the first or the last of them";
        }
        let is_doubtful = is_beyond || !is_alike;
        let frame = u32::try_from(frame.max(0)).unwrap_or(u32::MAX);
        Ok(Shown {
            frame,
            assumed,
            is_doubtful,
        })
    }
}

/// The lowest and the highest number of the pictures in a folder whose names are alike but for them, by both.
type Numbers = BTreeMap<(PathBuf, Option<(String, OsString)>), [i64; 2]>;

/// The lowest and the highest number of the pictures in the folder of `photo`, of that `number`, whose names are as its own.
fn numbers_beside(photo: &Path, number: i64, known: &mut Numbers) -> [i64; 2] {
    let head = |path: &Path| {
        let stem = path.file_stem()?.to_str()?.to_owned();
        let head = stem.trim_end_matches(|c: char| c.is_ascii_digit());
        Some((head.to_owned(), path.extension()?.to_owned()))
    };
    let (own, folder) = (head(photo), photo.parent().unwrap_or(Path::new("")));
    let widen = |[low, high]: [i64; 2], n: i64| [low.min(n), high.max(n)];
    let all = known
        .entry((folder.into(), own.clone()))
        .or_insert_with(|| {
            let beside = folder.read_dir().into_iter().flatten().flatten();
            let beside = beside.map(|entry| entry.path());
            let numbers = beside.filter(|path| head(path) == own);
            let numbers = numbers.filter_map(|path| file::number(&path));
            numbers.fold([number; 2], widen)
        });
    widen(*all, number)
}

/// The rate that is meant by one of keys from `start` to `end` that are rounded to single precision: a whole number, or
/// NTSC's of it, either way.
fn nominal(rate: f64, start: f64, end: f64) -> f64 {
    let rounding = f64::from(f32::EPSILON) * 2.0 * end.abs() / (end - start);
    let rates = [1.0, 1.0 / 1.001, 1.001].map(|ntsc| rate.round() * ntsc);
    let near = |meant: &f64| (rate / meant - 1.0).abs() < rounding;
    rates.into_iter().find(near).unwrap_or(rate)
}

/// A number for messages.
fn rounded(value: f64) -> f64 {
    (1e3 * value).round() / 1e3
}
