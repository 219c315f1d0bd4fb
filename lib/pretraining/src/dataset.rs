//! Recorded scenes on disk, in memory-mapped files of [`BLOCK`] scenes. Every file is written once. An interrupted run
//! continues at the first missing file.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use dipir_prior::caption::COLORS;
use half::f16;
use memmap2::Mmap;
use rayon::prelude::*;

use crate::direct_light::{DirectLightImages, PLANES};
use crate::error::{Error, Result, io};
use crate::lighting::Sun;
use crate::scene::{Framing, GeneratedScene, ObjectSet, SUNS, SceneKind, Setting};
use crate::square_camera::SquareCamera;

/// Scenes in a file.
pub const BLOCK: usize = 64;
/// Pixels on a side of a recorded picture. Examples are crops of it.
pub const RECORD_SIZE: usize = 40;
/// Numbers of a scene beside its planes: class and colour, pitch and field of view of the camera, suns.
const FACTS: usize = 4 + 3 * SUNS;

/// Which settings the scenes of a dataset have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneMix {
    /// Half open ground, half streets. The diffusion model is trained on them.
    OpenAndStreets,
    /// Half courtyards, a quarter each open ground and streets. The light encoder is trained on them.
    WithCourtyards,
}

impl SceneMix {
    fn setting(self, index: usize) -> Setting {
        match self {
            Self::OpenAndStreets => [Setting::Open, Setting::Street][index % 2],
            Self::WithCourtyards => [
                Setting::Open,
                Setting::Courtyard,
                Setting::Street,
                Setting::Courtyard,
            ][index % 4],
        }
    }

    /// Prefix of the names of files.
    fn prefix(self) -> &'static str {
        match self {
            Self::OpenAndStreets => "scenes",
            Self::WithCourtyards => "places",
        }
    }
}

/// Which scenes a dataset has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatasetSettings {
    /// Key of all random numbers.
    pub seed: u64,
    /// Number of scenes, rounded up to whole files.
    pub scenes: usize,
    /// Their settings.
    pub mix: SceneMix,
    /// Their main objects.
    pub objects: ObjectSet,
}

/// The recorded scenes of a folder.
#[derive(Debug)]
pub struct Dataset {
    blocks: Vec<Block>,
}

#[derive(Debug)]
struct Block {
    map: Mmap,
    planes: usize,
    facts: Vec<f32>,
}

/// One recorded scene.
#[derive(Debug, Clone)]
pub struct RecordedScene<'a> {
    /// [PLANES, RECORD_SIZE, RECORD_SIZE]
    pub planes: &'a [f16],
    /// Word for the main object.
    pub class: &'static str,
    /// Word for its colour.
    pub color: &'static str,
    /// The camera.
    pub camera: SquareCamera,
    /// Suns under which it is recorded.
    pub suns: Vec<Sun>,
}

fn block_path(folder: &Path, mix: SceneMix, block: usize) -> PathBuf {
    folder.join(format!("{}-{block:05}.safetensors", mix.prefix()))
}

impl Dataset {
    /// Traces the scenes that are missing in `folder`, then opens it. `progress` is called with the number of finished
    /// scenes and may stop the work; then the result is `None`.
    pub fn make(
        folder: &Path,
        settings: &DatasetSettings,
        progress: &mut dyn FnMut(usize) -> ControlFlow<()>,
    ) -> Result<Option<Self>> {
        std::fs::create_dir_all(folder).map_err(io("create", folder))?;
        let blocks = settings.scenes.div_ceil(BLOCK);
        for block in 0..blocks {
            let path = block_path(folder, settings.mix, block);
            if !path.is_file() {
                write_block(&path, settings, block)?;
            }
            if progress((block + 1) * BLOCK).is_break() {
                return Ok(None);
            }
        }
        Self::open(folder, settings.mix, blocks).map(Some)
    }

    /// The first `blocks` files of `folder`.
    pub fn open(folder: &Path, mix: SceneMix, blocks: usize) -> Result<Self> {
        let blocks = (0..blocks)
            .map(|b| Block::open(&block_path(folder, mix, b)))
            .collect::<Result<_>>()?;
        Ok(Self { blocks })
    }

    /// Number of scenes.
    pub fn len(&self) -> usize {
        self.blocks.len() * BLOCK
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.blocks.is_empty()
    }

    /// Scene number `index`.
    pub fn scene(&self, index: usize) -> RecordedScene<'_> {
        self.blocks[index / BLOCK].scene(index % BLOCK)
    }
}

/// Bytes of a scene's planes.
const PLANE_BYTES: usize = PLANES * RECORD_SIZE * RECORD_SIZE * 2;

impl Block {
    fn open(path: &Path) -> Result<Self> {
        let file = std::fs::File::open(path).map_err(io("read", path))?;
        // SAFETY: files are written completely, then renamed into place, and this program never changes them afterwards.
        let map = unsafe { Mmap::map(&file) }.map_err(io("map", path))?;
        let fail = |message: &str| Error::Content {
            path: path.to_owned(),
            message: format!("{message}; delete the file to have it made again"),
        };
        let weights = dipir_diffusion::weights::Weights::open_file(path)?;
        let facts = weights
            .tensor("facts", DType::F32, &Device::Cpu)?
            .ok_or_else(|| fail("the tensor \"facts\" is missing"))?;
        let shape = [BLOCK, PLANES, RECORD_SIZE, RECORD_SIZE];
        if weights.shape("planes") != Some(&shape) || facts.dims() != [BLOCK, FACTS] {
            return Err(fail("tensors have other shapes than this version writes"));
        }
        // Tensors are sorted by name, so "planes" fills the end of the file.
        let planes = map
            .len()
            .checked_sub(BLOCK * PLANE_BYTES)
            .filter(|at| at % 2 == 0)
            .ok_or_else(|| fail("the file is cut off"))?;
        Ok(Self {
            map,
            planes,
            facts: facts.flatten_all()?.to_vec1()?,
        })
    }

    fn scene(&self, index: usize) -> RecordedScene<'_> {
        let bytes = &self.map[self.planes + index * PLANE_BYTES..][..PLANE_BYTES];
        let facts = &self.facts[index * FACTS..][..FACTS];
        let word = |words: &'static [&'static str], at: f32| {
            words.get(at as usize).copied().unwrap_or("object")
        };
        RecordedScene {
            planes: bytemuck::cast_slice(bytes),
            class: word(&CLASSES, facts[0]),
            color: word(&COLORS, facts[1]),
            camera: SquareCamera {
                pitch: facts[2],
                tan_half_fov: facts[3],
            },
            suns: facts[4..]
                .chunks_exact(3)
                .map(|f| Sun {
                    azimuth: f[0],
                    elevation: f[1],
                    sharpness: f[2],
                })
                .collect(),
        }
    }
}

/// Words for classes, by the number in files.
const CLASSES: [&str; 8] = [
    "object", "ball", "box", "cylinder", "cone", "ring", "car", "table",
];

fn write_block(path: &Path, settings: &DatasetSettings, block: usize) -> Result<()> {
    let scenes: Vec<(Vec<f16>, Vec<f32>)> = (0..BLOCK)
        .into_par_iter()
        .map(|i| {
            let index = (block * BLOCK + i) as u64;
            let scene = GeneratedScene::draw(
                settings.seed,
                index,
                RECORD_SIZE as u32,
                SceneKind {
                    objects: settings.objects,
                    setting: settings.mix.setting(i),
                    framing: Framing::Close,
                },
            );
            let images = DirectLightImages::trace(&scene, settings.seed, index);
            let planes = images.planes.iter().map(|&v| f16::from_f32(v)).collect();
            let position = |words: &[&str], word: &str| {
                words.iter().position(|w| *w == word).unwrap_or(0) as f32
            };
            let camera = scene.square_camera();
            let mut facts = vec![
                position(&CLASSES, scene.shape.word()),
                position(&COLORS, scene.main_paint.word),
                camera.pitch,
                camera.tan_half_fov,
            ];
            for sun in &scene.suns {
                facts.extend([sun.azimuth, sun.elevation, sun.sharpness]);
            }
            (planes, facts)
        })
        .collect();
    let facts: Vec<f32> = scenes.iter().flat_map(|s| s.1.iter().copied()).collect();
    let planes: Vec<f16> = scenes.into_iter().flat_map(|s| s.0).collect();
    let shape = (BLOCK, PLANES, RECORD_SIZE, RECORD_SIZE);
    let tensors = BTreeMap::from([
        (
            "facts".to_owned(),
            Tensor::from_vec(facts, (BLOCK, FACTS), &Device::Cpu)?,
        ),
        (
            "planes".to_owned(),
            Tensor::from_vec(planes, shape, &Device::Cpu)?,
        ),
    ]);
    let metadata = BTreeMap::from([("seed".to_owned(), settings.seed.to_string())]);
    Ok(dipir_diffusion::weights::write_safetensors(
        path, &tensors, &metadata,
    )?)
}
