//! Records of many scenes on disk: files of [`BLOCK`] scenes, written once
//! and memory-mapped. A run that was stopped goes on at the first missing
//! file.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use half::f16;
use memmap2::Mmap;
use rayon::prelude::*;

use crate::error::{Error, Result, io};
use crate::lights::Sun;
use crate::record::{PLANES, Record};
use crate::studio::{Brief, Kinds, Outlook, SUNS, Setting, Stage, View};

/// Scenes in a file.
pub const BLOCK: usize = 64;
/// Pixels on a side of a recorded picture; examples are crops of it.
pub const RECORD_SIZE: usize = 40;
/// Numbers about a scene beside its planes: words for class and colour, pitch and reach of the camera, its suns.
const FACTS: usize = 4 + 3 * SUNS;

/// What the scenes of a dataset show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Places {
    /// An object in the middle, every second time in a street: what the diffusion model is trained on.
    Objects,
    /// Anything, as crops of photographs show it; every second time a yard: what the light encoder is trained on.
    Anywhere,
}

impl Places {
    fn setting(self, index: usize) -> Setting {
        match self {
            Self::Objects => [Setting::Open, Setting::Street][index % 2],
            Self::Anywhere => {
                [Setting::Open, Setting::Yard, Setting::Street, Setting::Yard][index % 4]
            }
        }
    }

    /// What names of files begin with.
    fn prefix(self) -> &'static str {
        match self {
            Self::Objects => "scenes",
            Self::Anywhere => "places",
        }
    }
}

/// Which scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DatasetSettings {
    /// Key of all random numbers.
    pub seed: u64,
    /// How many scenes; rounded up to whole files.
    pub scenes: usize,
    /// What they show.
    pub places: Places,
    /// Which main objects.
    pub kinds: Kinds,
}

/// The scenes of a folder.
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
pub struct SceneView<'a> {
    /// [PLANES, RECORD_SIZE, RECORD_SIZE]
    pub planes: &'a [f16],
    /// The word for the main object.
    pub class: &'static str,
    /// The word for its colour.
    pub color: &'static str,
    /// How the camera looks at it.
    pub outlook: Outlook,
    /// Its suns.
    pub suns: Vec<Sun>,
}

fn block_path(folder: &Path, places: Places, block: usize) -> PathBuf {
    folder.join(format!("{}-{block:05}.safetensors", places.prefix()))
}

impl Dataset {
    /// Traces what is missing of `folder`, then opens it. `progress` is told
    /// the number of finished scenes and may stop the work.
    pub fn make(
        folder: &Path,
        settings: &DatasetSettings,
        progress: &mut dyn FnMut(usize) -> ControlFlow<()>,
    ) -> Result<Option<Self>> {
        std::fs::create_dir_all(folder).map_err(io("create", folder))?;
        let blocks = settings.scenes.div_ceil(BLOCK);
        for block in 0..blocks {
            let path = block_path(folder, settings.places, block);
            if !path.is_file() {
                write_block(&path, settings, block)?;
            }
            if progress((block + 1) * BLOCK).is_break() {
                return Ok(None);
            }
        }
        Self::open(folder, settings.places, blocks).map(Some)
    }

    /// The first `blocks` files of `folder`.
    pub fn open(folder: &Path, places: Places, blocks: usize) -> Result<Self> {
        let blocks = (0..blocks)
            .map(|b| Block::open(&block_path(folder, places, b)))
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
    pub fn scene(&self, index: usize) -> SceneView<'_> {
        self.blocks[index / BLOCK].scene(index % BLOCK)
    }
}

/// Bytes of a scene's planes.
const PLANE_BYTES: usize = PLANES * RECORD_SIZE * RECORD_SIZE * 2;

impl Block {
    fn open(path: &Path) -> Result<Self> {
        let file = std::fs::File::open(path).map_err(io("read", path))?;
        // SAFETY: the files are written whole and renamed into place, and
        // nothing in this program changes them afterwards.
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
        // "planes" sorts last and fills the end of the file.
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

    fn scene(&self, index: usize) -> SceneView<'_> {
        let bytes = &self.map[self.planes + index * PLANE_BYTES..][..PLANE_BYTES];
        let facts = &self.facts[index * FACTS..][..FACTS];
        let word = |words: &'static [&'static str], at: f32| {
            words.get(at as usize).copied().unwrap_or("object")
        };
        SceneView {
            planes: bytemuck::cast_slice(bytes),
            class: word(&CLASSES, facts[0]),
            color: word(&crate::words::COLORS, facts[1]),
            outlook: Outlook {
                pitch: facts[2],
                reach: facts[3],
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

/// Words for kinds of objects, by the number that files hold.
const CLASSES: [&str; 8] = [
    "object", "ball", "box", "cylinder", "cone", "ring", "car", "table",
];

fn write_block(path: &Path, settings: &DatasetSettings, block: usize) -> Result<()> {
    let scenes: Vec<(Vec<f16>, Vec<f32>)> = (0..BLOCK)
        .into_par_iter()
        .map(|i| {
            let index = (block * BLOCK + i) as u64;
            let stage = Stage::draw(
                settings.seed,
                index,
                RECORD_SIZE as u32,
                Brief {
                    kinds: settings.kinds,
                    // Photographs of real places show more than open ground.
                    setting: settings.places.setting(i),
                    view: View::Close,
                },
            );
            let record = Record::trace(&stage, settings.seed, index);
            let planes = record.planes.iter().map(|&v| f16::from_f32(v)).collect();
            let position = |words: &[&str], word: &str| {
                words.iter().position(|w| *w == word).unwrap_or(0) as f32
            };
            let outlook = stage.outlook();
            let mut facts = vec![
                position(&CLASSES, stage.shape.word()),
                position(&crate::words::COLORS, stage.main_paint.word),
                outlook.pitch,
                outlook.reach,
            ];
            for sun in &stage.suns {
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
