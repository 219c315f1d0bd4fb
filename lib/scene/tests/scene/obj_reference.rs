//! On legal files our OBJ reader and `tobj` agree.
use dipir_scene::import::{Limits, NoFiles, load_obj_bytes};
use glam::Vec3;
use proptest::prelude::*;

/// A corner's position and normal.
type Corner = ([f32; 3], Option<[f32; 3]>);

/// A face of three to six corners: indices of position and normal, counted from the start or from
/// the end.
#[derive(Clone, Debug)]
struct Face {
    corners: Vec<(prop::sample::Index, prop::sample::Index)>,
    from_end: bool,
    with_normals: bool,
}

fn face() -> impl Strategy<Value = Face> {
    (
        proptest::collection::vec(any::<(prop::sample::Index, prop::sample::Index)>(), 3..7),
        any::<bool>(),
        any::<bool>(),
    )
        .prop_map(|(corners, from_end, with_normals)| Face {
            corners,
            from_end,
            with_normals,
        })
}

fn number() -> impl Strategy<Value = f32> {
    prop_oneof![
        -100.0f32..100.0,
        Just(0.0f32),
        Just(1e-20f32),
        Just(-3e7f32)
    ]
}

fn normal() -> impl Strategy<Value = [f32; 3]> {
    (number(), number(), 0.5f32..1.0).prop_map(|(x, y, z)| [x, y, z])
}

/// The text of a file, each face in a group of its own where `tobj` would mix corners with normals
/// and such without.
fn text(positions: &[[f32; 3]], normals: &[[f32; 3]], faces: &[Face]) -> String {
    use std::fmt::Write;
    let mut out = String::from("# made up\n");
    for [x, y, z] in positions {
        writeln!(out, "v {x} {y:e} {z}").unwrap();
    }
    for [x, y, z] in normals {
        writeln!(out, "vn {x} {y} {z}").unwrap();
    }
    for (i, face) in faces.iter().enumerate() {
        write!(out, "g part{i}\nf").unwrap();
        for (p, n) in &face.corners {
            let shown = |at: usize, count: usize| match face.from_end {
                true => at as i64 - count as i64,
                false => at as i64 + 1,
            };
            let p = shown(p.index(positions.len()), positions.len());
            match face.with_normals {
                true => write!(
                    out,
                    " {p}//{}",
                    shown(n.index(normals.len()), normals.len())
                ),
                false => write!(out, " {p}"),
            }
            .unwrap();
        }
        out.push('\n');
    }
    out
}

/// What `tobj` reads, triangle by triangle, but for those that name a corner twice.
fn reference(text: &str) -> Vec<[Corner; 3]> {
    let options = tobj::LoadOptions {
        triangulate: true,
        ..tobj::LoadOptions::default()
    };
    let no_materials = |_: &std::path::Path| Err(tobj::LoadError::OpenFileFailed);
    let (models, _) = tobj::load_obj_buf(&mut text.as_bytes(), &options, no_materials).unwrap();
    let mut all = Vec::new();
    for mesh in models.iter().map(|m| &m.mesh) {
        let triple = |values: &[f32], i: u32| {
            let at = 3 * i as usize;
            [values[at], values[at + 1], values[at + 2]]
        };
        for t in 0..mesh.indices.len() / 3 {
            let at = [3 * t, 3 * t + 1, 3 * t + 2];
            // Indices without normals mean nothing.
            let normal = |k: usize| {
                mesh.normal_indices
                    .get(k)
                    .filter(|_| !mesh.normals.is_empty())
            };
            let keys = at.map(|k| (mesh.indices[k], normal(k)));
            if keys[0] != keys[1] && keys[1] != keys[2] && keys[2] != keys[0] {
                all.push(keys.map(|(p, n)| {
                    (
                        triple(&mesh.positions, p),
                        n.map(|n| triple(&mesh.normals, *n)),
                    )
                }));
            }
        }
    }
    all
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn triangles_and_normals_are_those_that_tobj_reads(
        mut positions in proptest::collection::vec([number(), number(), number()], 3..12),
        normals in proptest::collection::vec(normal(), 1..6),
        mut faces in proptest::collection::vec(face(), 1..8),
        with_normals in any::<bool>(),
        convex in any::<bool>(),
    ) {
        // Beyond thousands places are kept relative to the first.
        positions[0] = positions[0].map(|v| v.max(-100.0));
        // `tobj` makes a fan of every face, of a concave one, too: these corners are in order on a parabola.
        let count = positions.len();
        for (i, position) in positions.iter_mut().enumerate().filter(|_| convex) {
            *position = [i as f32, (i * i) as f32, 0.0];
        }
        for face in &mut faces {
            match convex {
                true => face.corners.sort_by_key(|(p, _)| p.index(count)),
                false => face.corners.truncate(3),
            }
        }
        // In a file with normals `tobj` gives some to every corner.
        faces.iter_mut().for_each(|f| f.with_normals = with_normals);
        let normals = if with_normals { normals } else { Vec::new() };
        let text = text(&positions, &normals, &faces);
        let expected = reference(&text);
        let read = load_obj_bytes(text.as_bytes(), &NoFiles, &Limits::default());
        if expected.is_empty() {
            prop_assert!(read.is_err());
            return Ok(());
        }
        let mesh = read.unwrap().mesh;
        prop_assert_eq!(mesh.indices.len(), expected.len());
        for (triangle, corners) in mesh.indices.iter().zip(expected) {
            for (i, (position, normal)) in triangle.iter().zip(corners) {
                prop_assert_eq!(mesh.positions[*i as usize].to_array(), position);
                if let Some(normal) = normal {
                    let unit = Vec3::from_array(normal).as_dvec3().normalize().as_vec3();
                    prop_assert_eq!(mesh.normals[*i as usize], unit);
                }
            }
        }
    }

    #[test]
    fn vertex_colours_are_those_that_tobj_reads(
        vertices in proptest::collection::vec(([number(), number(), number()], [0.0f32..=1.0, 0.0f32..=1.0, 0.0f32..=1.0]), 3),
    ) {
        let mut text = String::new();
        for ([x, y, z], [r, g, b]) in &vertices {
            text += &format!("v {x} {y} {z} {r} {g} {b}\n");
        }
        text += "f 1 2 3\n";
        let (models, _) = tobj::load_obj_buf(
            &mut text.as_bytes(),
            &tobj::LoadOptions::default(),
            |_| Err(tobj::LoadError::OpenFileFailed),
        ).unwrap();
        let mesh = load_obj_bytes(text.as_bytes(), &NoFiles, &Limits::default()).unwrap().mesh;
        let expected = &models[0].mesh.vertex_color;
        prop_assert_eq!(expected.len(), 9);
        for (i, color) in mesh.colors.iter().enumerate() {
            for k in 0..3 {
                // sRGB and back, which the curve's toe and power round.
                let stored = expected[3 * i + k];
                let linear = if stored <= 0.04045 {
                    stored / 12.92
                } else {
                    ((stored + 0.055) / 1.055).powf(2.4)
                };
                prop_assert!((color[k] - linear).abs() < 1e-6);
            }
        }
    }
}
