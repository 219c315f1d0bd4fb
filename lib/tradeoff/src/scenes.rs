//! The scenes that are measured: three that differ, made here, or projects of the user's.
use std::f32::consts::{PI, TAU};
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_imaging::exposure::automatic_exposure_ev;
use dipir_imaging::file::write_png;
use dipir_imaging::raster::LinearImage;
use dipir_imaging::transfer::Transfer;
use dipir_render::shapes::{append, icosphere, torus_knot};
use dipir_scene::export::to_obj;
use dipir_scene::import::{EXTENSIONS, load_object};
use dipir_scene::mesh::TriangleMesh;
use dipir_stages::scene::background::PanoramaView;
use glam::{Vec2, Vec3};

use crate::lights::{hazy, indoors, outdoors};

/// A project that is measured.
#[derive(Clone, Debug)]
pub struct MeasuredScene {
    /// In tables and plots.
    pub name: String,
    /// Lit by a known light.
    pub lit: PathBuf,
    /// To recover the light from `truth.exr` beside it; built-in scenes alone.
    pub recover: Option<PathBuf>,
    /// Hash of the file `lit` and of the files that it names; empty for built-in scenes, which nobody edits.
    pub digest: String,
}

/// Names of the built-in scenes.
pub const NAMES: [&str; 3] = ["matte outdoors", "glossy indoors", "concave"];

/// The built-in scene `name` in `folder`, there or not.
pub fn kept(name: &str, folder: &Path) -> MeasuredScene {
    MeasuredScene {
        name: name.into(),
        lit: folder.join("pipeline.toml"),
        recover: Some(folder.join("recover.toml")),
        digest: String::new(),
    }
}

/// Writes the built-in scene `name` into `folder`, unless it is there.
pub fn built_in(name: &str, folder: &Path, size: [usize; 2]) -> anyhow::Result<MeasuredScene> {
    let scene = kept(name, folder);
    if scene.lit.is_file() {
        return Ok(scene);
    }
    let failed = || format!("cannot write the scene \"{name}\" to {}", folder.display());
    fs::create_dir_all(folder).with_context(failed)?;
    let (mesh, materials, map) = match name {
        "matte outdoors" => (
            torus_knot(Vec3::Y * 0.75, 0.45, 0.17, 256, 24),
            "newmtl m0\nKd 0.6 0.55 0.5\nPr 1.0\nPm 0.0\n",
            outdoors(),
        ),
        "glossy indoors" => {
            let mut mesh = torus_knot(Vec3::Y * 0.75, 0.45, 0.15, 256, 24);
            append(&mut mesh, icosphere(Vec3::new(0.9, 0.3, 0.6), 0.3, 4), 1);
            let materials = "newmtl m0\nKd 0.8 0.4 0.2\nPr 0.15\nPm 0.0\n\
                             newmtl m1\nKd 0.9 0.85 0.75\nPr 0.1\nPm 1.0\n";
            (mesh, materials, indoors())
        }
        _ => {
            let mut mesh = bowl();
            append(&mut mesh, icosphere(Vec3::new(0.1, 0.42, 0.0), 0.22, 4), 1);
            let materials = "newmtl m0\nKd 0.85 0.35 0.15\nPr 0.9\nPm 0.0\n\
                             newmtl m1\nKd 0.8 0.8 0.8\nPr 0.6\nPm 0.0\n";
            (mesh, materials, hazy())
        }
    };
    fs::write(folder.join("object.obj"), to_obj(&mesh, "object")).with_context(failed)?;
    fs::write(folder.join("object.mtl"), materials).with_context(failed)?;
    map.write(folder.join("map.exr"))?;
    let view = PanoramaView {
        fov_rad: 40f32.to_radians(),
        yaw_rad: 0.4,
        pitch_rad: -16f32.to_radians(),
        roll_rad: 0.0,
        width: size[0],
        height: size[1],
    };
    let image = view.take(&map);
    let exposure_ev = automatic_exposure_ev(&image);
    let exposed = LinearImage(image.0.map(|p| *p * exposure_ev.exp2()));
    write_png(folder.join("photo.png"), &Transfer::Srgb.encode(&exposed))?;
    let forward = -view.rotation().z_axis;
    let across = Vec2::new(forward.x, forward.z).normalize() * -4.2;
    let position = Vec3::new(across.x, 1.75, across.y);
    let look_at = position + forward;
    let camera = format!(
        "[scene]\nbackground = \"photo.png\"\nclass = \"object\"\n\n\
         [[scene.objects]]\npath = \"object.obj\"\n\n\
         [scene.camera]\nposition = {:?}\nlook_at = {:?}\nfov_deg = 40.0\n\n\
         [scene.proxy]\nplane = {{ point = [0.0, 0.0, 0.0], normal = [0.0, 1.0, 0.0] }}\n\n",
        position.to_array(),
        look_at.to_array()
    );
    let recover = "[light]\nguidance = \"reference\"\nreference = \"truth.exr\"\n\
                   preview_every = 0\ncheckpoint_every = 0\n";
    fs::write(folder.join("recover.toml"), format!("{camera}{recover}")).with_context(failed)?;
    let lit = format!(
        "{camera}[composite]\nenvironment = \"map.exr\"\nexposure_ev = {exposure_ev:.4}\ntone = \"reinhard\"\n"
    );
    // Last: a scene is there once this file is.
    fs::write(&scene.lit, lit).with_context(failed)?;
    Ok(scene)
}

/// Projects of the user's, named by their folders; by their files where folders have the same name.
pub fn projects(pipelines: &[PathBuf]) -> Vec<MeasuredScene> {
    let folders: Vec<String> = pipelines.iter().map(|p| folder_of(p)).collect();
    let named = |(pipeline, folder): (&PathBuf, &String)| MeasuredScene {
        name: match folders.iter().filter(|f| *f == folder).count() {
            1 => folder.clone(),
            _ => pipeline.display().to_string(),
        },
        lit: pipeline.clone(),
        recover: None,
        digest: digest(pipeline),
    };
    pipelines.iter().zip(&folders).map(named).collect()
}

/// Hash of a project's file, of the files whose paths it has in quotation marks, and of those that an object among them
/// consists of. A file that cannot be read, which its stage says, counts as an empty one.
fn digest(pipeline: &Path) -> String {
    let folder = pipeline.parent().unwrap_or(Path::new(""));
    let text = fs::read(pipeline).unwrap_or_default();
    let mut hash = blake3::Hasher::new();
    hash.update(&text);
    let mut add = |path: &Path| {
        let bytes = fs::read(path).unwrap_or_default();
        hash.update(blake3::hash(&bytes).as_bytes());
    };
    for quoted in String::from_utf8_lossy(&text).split(['"', '\'', '\n']) {
        let path = folder.join(quoted);
        if !quoted.is_empty() && path.is_file() {
            add(&path);
            parts(&path).iter().for_each(|part| add(part));
        }
    }
    hash.finalize().to_hex()[..8].to_owned()
}

/// The further files that an object consists of: materials, buffers, textures. None of what is no object.
fn parts(path: &Path) -> Vec<PathBuf> {
    let extension = path.extension().unwrap_or_default().to_string_lossy();
    if !EXTENSIONS.contains(&&*extension.to_lowercase()) {
        return Vec::new();
    }
    load_object(path).map_or(Vec::new(), |object| object.dependencies)
}

/// The name of the folder that a file lies in.
pub fn folder_of(file: &Path) -> String {
    let folder = file.parent().and_then(|f| f.canonicalize().ok());
    let name = folder.as_deref().and_then(Path::file_name);
    name.map_or("project".into(), |n| n.to_string_lossy().into_owned())
}

/// A bowl with a wall, open above, that stands on y = 0.
fn bowl() -> TriangleMesh {
    const AROUND: u32 = 64;
    const ALONG: u32 = 24;
    // The profile, from the outside's foot over the rim to the inside's middle.
    let profile: Vec<Vec2> = (0..=2 * ALONG)
        .map(|k| {
            let (radius, t) = match k <= ALONG {
                true => (0.95, k as f32 / ALONG as f32),
                false => (0.85, (2 * ALONG - k) as f32 / ALONG as f32),
            };
            let angle = 0.5 * PI * t;
            Vec2::new(radius * angle.sin(), 0.97 - radius * angle.cos())
        })
        .collect();
    let mut mesh = TriangleMesh::default();
    for p in &profile {
        for j in 0..AROUND {
            let (s, c) = (j as f32 / AROUND as f32 * TAU).sin_cos();
            mesh.positions.push(Vec3::new(p.x * c, p.y, p.x * s));
        }
    }
    for k in 0..profile.len() as u32 - 1 {
        for j in 0..AROUND {
            let at = |k: u32, j: u32| k * AROUND + j % AROUND;
            let (a, b, c, d) = (at(k, j), at(k, j + 1), at(k + 1, j + 1), at(k + 1, j));
            // The ends of the profile are points.
            if k > 0 {
                mesh.indices.push([a, c, b]);
            }
            if k as usize + 2 < profile.len() {
                mesh.indices.push([a, d, c]);
            }
        }
    }
    mesh.materials = vec![0; mesh.indices.len()];
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bowl_is_closed_and_its_triangles_face_outwards() {
        let mesh = bowl();
        let volume: f32 = mesh
            .indices
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
                a.dot(b.cross(c)) / 6.0
            })
            .sum();
        // Half a shell between radii .95 and .85, less what its rim, which slants, and its corners cut off.
        let shell = 2.0 / 3.0 * PI * (0.95f32.powi(3) - 0.85f32.powi(3));
        assert!((0.94..1.0).contains(&(volume / shell)), "{volume} {shell}");
        let (low, high) = mesh.bounds().unwrap();
        assert!(low.y > 0.0 && high.y < 1.0);
    }
}
