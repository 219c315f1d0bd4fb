//! A real place: its panorama, and its light taken apart into a smooth part and the strongest source.
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use dipir_light::environment::EnvironmentMap;
use dipir_light::luminance::luminance;
use glam::Vec3;
use rayon::prelude::*;

use crate::error::PlacesError;

/// Columns and rows of panoramas that views are taken from.
const PANORAMA: [usize; 2] = [1024, 512];
/// Columns and rows of the smooth part; headings are whole columns.
pub const SMOOTH: [usize; 2] = [64, 32];
/// Columns and rows on which the brightest direction is looked for: 2.8 degrees.
const PEAK_GRID: [usize; 2] = [128, 64];
/// The strongest source lies within this angle of the brightest direction, degrees.
const SOURCE_DEG: f32 = 10.0;
/// Directions between the source and this angle are its surroundings, degrees. They do not count as source.
const RING_DEG: f32 = 20.0;
/// A source is like a sun if this share of it lies within 3 degrees.
const SUN_SHARPNESS: f64 = 0.8;
/// And if it has this share of all light.
const SUN_SHARE: f64 = 0.2;

/// A panorama and what is to be learned of its light.
#[derive(Clone, Debug)]
pub struct Place {
    /// The file's name without its resolution and extension.
    pub name: String,
    /// Kind of place, from `panoramas.tsv` beside it; "place" without one.
    pub kind: String,
    /// Places of one group are in one fold: the same rooms or fields seen again.
    pub group: String,
    /// What is seen.
    pub panorama: EnvironmentMap,
    /// Light without the strongest source.
    pub smooth: EnvironmentMap,
    /// Unit vector towards the strongest source, in the panorama.
    pub peak: Vec3,
    /// Its radiance over that of its surroundings, integrated over its solid angle.
    pub energy: Vec3,
    /// Its share of all light.
    pub share: f64,
    /// Whether it is like a sun.
    pub sun: bool,
}

impl Place {
    /// Reads a panorama.
    pub fn read(path: &Path, kind: &str) -> Result<Self, PlacesError> {
        let map = EnvironmentMap::read(path)?;
        let stem = path
            .file_stem()
            .map(|s| s.to_string_lossy().into_owned())
            .unwrap_or_default();
        let name = ["_1k", "_2k", "_4k"]
            .iter()
            .fold(stem.as_str(), |n, s| n.strip_suffix(s).unwrap_or(n));
        Ok(Self::new(
            name,
            kind,
            map.resampled(PANORAMA[0], PANORAMA[1]),
        ))
    }

    /// Takes a panorama's light apart.
    pub fn new(name: &str, kind: &str, panorama: EnvironmentMap) -> Self {
        let (width, height) = (panorama.width(), panorama.height());
        let (brightest, _) = panorama.resampled(PEAK_GRID[0], PEAK_GRID[1]).peak();
        let cos = |deg: f32| deg.to_radians().cos();
        let each = |test: &dyn Fn(f32) -> bool| -> Vec<(usize, Vec3, f64)> {
            let all = (0..width * height).map(|k| (k, panorama.direction_of(k / width, k % width)));
            all.filter(|(_, d)| test(d.dot(brightest)))
                .map(|(k, d)| (k, d, panorama.solid_angle(k / width)))
                .collect()
        };
        let ring = each(&|c| c <= cos(SOURCE_DEG) && c > cos(RING_DEG));
        let area: f64 = ring.iter().map(|r| r.2).sum();
        let around = ring
            .iter()
            .map(|r| panorama.texels()[r.0].as_dvec3() * r.2)
            .sum::<glam::DVec3>()
            / area;
        let around = around.as_vec3();
        let mut smooth = panorama.texels().to_vec();
        let (mut energy, mut centre, mut power, mut sharp) =
            (glam::DVec3::ZERO, glam::DVec3::ZERO, 0.0, 0.0);
        for (k, d, size) in each(&|c| c > cos(SOURCE_DEG)) {
            let excess = (smooth[k] - around).max(Vec3::ZERO);
            smooth[k] -= excess;
            let weight = f64::from(luminance(excess)) * size;
            energy += excess.as_dvec3() * size;
            centre += d.as_dvec3() * weight;
            power += weight;
            sharp += if d.dot(brightest) > cos(3.0) {
                weight
            } else {
                0.0
            };
        }
        let peak = if power > 0.0 {
            centre.normalize().as_vec3()
        } else {
            brightest
        };
        let total = dipir_light::luminance::luminance_f64(panorama.integral());
        let share = if total > 0.0 { power / total } else { 0.0 };
        let smooth = EnvironmentMap::new(width, height, smooth)
            .map_or_else(|_| panorama.clone(), |m| m.resampled(SMOOTH[0], SMOOTH[1]));
        Self {
            name: name.into(),
            kind: kind.into(),
            group: group_of(name),
            smooth,
            panorama,
            peak,
            energy: energy.as_vec3(),
            share,
            sun: share >= SUN_SHARE && sharp >= SUN_SHARPNESS * power,
        }
    }

    /// Mean radiance over the sphere.
    pub fn mean(&self) -> Vec3 {
        (self.panorama.integral() / (4.0 * std::f64::consts::PI)).as_vec3()
    }
}

/// Names that differ in their numbers and in a word for the sky alone are one place seen again.
pub(crate) fn group_of(name: &str) -> String {
    let parts: Vec<&str> = name
        .split('_')
        .filter(|p| *p != "puresky" && !p.chars().all(|c| c.is_ascii_digit()))
        .collect();
    parts.join("_")
}

/// All panoramas of a folder by name. Kinds come from `panoramas.tsv` (columns `name` and `kind`), if it is there.
pub fn read_places(folder: &Path) -> Result<Vec<Place>, PlacesError> {
    let failed = |source| PlacesError::File {
        what: "read",
        path: folder.to_owned(),
        source,
    };
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        if matches!(extension.as_deref(), Some("hdr" | "exr")) {
            files.push(path);
        }
    }
    files.sort();
    let kinds = kinds(&folder.join("panoramas.tsv"));
    let kind = |path: &Path| {
        let stem = path
            .file_stem()
            .map(|s| s.to_string_lossy().into_owned())
            .unwrap_or_default();
        let of = |(name, kind): (&String, &String)| {
            names(name, &stem).then(|| (name.len(), kind.clone()))
        };
        kinds
            .iter()
            .filter_map(of)
            .max()
            .map_or_else(|| "place".to_string(), |(_, k)| k)
    };
    files
        .par_iter()
        .map(|path| Place::read(path, &kind(path)))
        .collect()
}

/// Whether a name in the table is that of a file without its extension and, where the name has none, its resolution
/// (`_4k`).
fn names(name: &str, stem: &str) -> bool {
    stem.strip_prefix(name).is_some_and(|rest| {
        let digits = rest.strip_prefix('_').and_then(|r| r.strip_suffix('k'));
        rest.is_empty()
            || digits.is_some_and(|d| !d.is_empty() && d.bytes().all(|b| b.is_ascii_digit()))
    })
}

/// The first word of each kind; empty without a table.
fn kinds(table: &Path) -> BTreeMap<String, String> {
    let text = dipir_files::read_to_string(table).unwrap_or_default();
    let mut lines = text.lines();
    let header: Vec<&str> = lines.next().unwrap_or_default().split('\t').collect();
    let column = |name: &str| header.iter().position(|h| *h == name);
    let (Some(name), Some(kind)) = (column("name"), column("kind")) else {
        return BTreeMap::new();
    };
    lines
        .filter_map(|line| {
            let cells: Vec<&str> = line.split('\t').collect();
            let kind = cells.get(kind)?;
            let word = if kind.contains("night") {
                "night"
            } else {
                kind.split(' ').next()?
            };
            Some(((*cells.get(name)?).to_string(), word.to_string()))
        })
        .collect()
}

/// The [`folds`] of a folder's places, none of them empty.
///
/// # Errors
/// If there are fewer places than folds.
pub fn filled_folds(
    folder: &Path,
    places: &[Place],
    count: usize,
) -> Result<Vec<usize>, PlacesError> {
    let groups: BTreeSet<&str> = places.iter().map(|p| p.group.as_str()).collect();
    match groups.len() {
        found if found < count => Err(PlacesError::TooFew {
            path: folder.to_owned(),
            found,
            folds: count,
        }),
        _ => Ok(folds(places, count)),
    }
}

/// The fold of each place, dealt out by kind and by the strongest source's share, groups together.
pub(crate) fn folds(places: &[Place], count: usize) -> Vec<usize> {
    let mut groups: BTreeMap<&str, (&str, f64)> = BTreeMap::new();
    for p in places {
        groups.entry(&p.group).or_insert((&p.kind, p.share));
    }
    let mut order: Vec<(&str, (&str, f64))> = groups.into_iter().collect();
    order.sort_by(|a, b| {
        a.1.0
            .cmp(b.1.0)
            .then(a.1.1.total_cmp(&b.1.1))
            .then(a.0.cmp(b.0))
    });
    let fold: BTreeMap<&str, usize> = order
        .iter()
        .enumerate()
        .map(|(n, g)| (g.0, n % count))
        .collect();
    places.iter().map(|p| fold[p.group.as_str()]).collect()
}
