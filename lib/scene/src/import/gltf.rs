//! glTF 2.0 and GLB files.
//!
//! The `gltf` crate opens the container and parses the JSON; its readers of accessors are not used.
//! Nothing in a file is trusted: every index, length and offset is checked before it is followed,
//! so that any bytes end in an object or in one error that says where the file is wrong.
use std::borrow::Cow;
use std::collections::BTreeMap;

use glam::{DMat4, DQuat, DVec3};
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked;

use super::accessor::{Buffers, get};
use super::container::{self, Resolver};
use super::document::{Document, Instancing, Placement, raw_extension};
use super::gltf_material::{IMAGE_EXTENSIONS, MaterialReader, PLAIN_IMAGES};
use super::gltf_mesh::MeshReader;
use super::{Imported, Limits};
use crate::error::Error;
use crate::material::Material;
use crate::mesh::TriangleMesh;

const EXPORT: &str = "export the file again";

const INSTANCING: &str = "EXT_mesh_gpu_instancing";

/// Extensions that a file may require; those of materials that are not read change the look, not
/// the shape, and are warned about.
const ACCEPTED: [&str; 8] = [
    INSTANCING,
    "EXT_texture_transform",
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
    "KHR_node_visibility",
];

/// Beyond this many copies in all a file is broken or hostile.
const MAX_INSTANCES: u64 = 1 << 22;

/// Reads a glTF or GLB file from memory; `resolver` finds the files that it names.
pub fn load_gltf_bytes(
    bytes: &[u8],
    resolver: &dyn Resolver,
    limits: &Limits,
) -> Result<Imported, Error> {
    let (json, binary) = container::split(bytes)?;
    let document = Document::read(json)?;
    check_header(&document)?;
    let data = buffer_data(&document, binary, resolver)?;
    // A quantity per vertex or three indices a triangle: no honest accessor is longer.
    let buffers = Buffers::new(
        &document,
        data,
        3 * limits.max_triangles.max(limits.max_vertices),
    );

    let globals = global_transforms(&document)?;
    let groups = instances(&document, &buffers, &globals)?;
    let mut materials = MaterialReader::new(&document, &buffers, resolver);
    let mut list = Vec::with_capacity(document.materials.len() + 1);
    for i in 0..document.materials.len() {
        list.push(materials.read(i)?);
    }
    let mut meshes = MeshReader::new(&document, &buffers, &globals, &list);
    let (mesh, origin) = assemble(&document, &buffers, &mut meshes, groups, limits)?;
    let mut warnings = std::mem::take(&mut meshes.warnings);
    let uses_default = meshes.uses_default_material;
    if uses_default {
        list.push(Material::default());
    }
    if mesh.indices.is_empty() {
        return Err(Error::Empty {
            remedy: "check that the file's default scene contains a mesh",
        });
    }
    if !document.animations.is_empty() {
        warnings.push("animations are ignored: the object stands still in its rest pose".into());
    }
    warnings.append(&mut materials.warnings);
    let mut seen = std::collections::HashSet::new();
    warnings.retain(|w| seen.insert(w.clone()));
    Ok(Imported {
        mesh,
        origin,
        materials: list,
        textures: materials.textures,
        warnings,
        dependencies: Vec::new(),
    })
}

fn check_header(document: &Document) -> Result<(), Error> {
    let version = &document.asset.version;
    if !version.starts_with("2.") {
        return Err(Error::malformed(
            format!("asset.version is \"{version}\"; accepted: 2.0"),
            "export the file as glTF 2.0",
        ));
    }
    for name in &document.extensions_required {
        if ACCEPTED.contains(&name.as_str()) || name.starts_with("KHR_materials_") {
            continue;
        }
        let remedy = if IMAGE_EXTENSIONS.contains(&name.as_str()) {
            PLAIN_IMAGES
        } else if name.contains("compression") {
            "export the object without mesh compression"
        } else {
            "export the object without it"
        };
        return Err(Error::UnsupportedExtension {
            extension: name.clone(),
            remedy,
        });
    }
    Ok(())
}

fn buffer_data<'a>(
    document: &Document,
    binary: Option<&'a [u8]>,
    resolver: &dyn Resolver,
) -> Result<Vec<Option<Cow<'a, [u8]>>>, Error> {
    let mut all = Vec::with_capacity(document.buffers.len());
    for (i, buffer) in document.buffers.iter().enumerate() {
        let at = format!("buffers[{i}]");
        let data: Option<Cow<[u8]>> = match &buffer.uri {
            None => binary.filter(|_| i == 0).map(Cow::Borrowed),
            Some(uri) => Some(Cow::Owned(match container::data_uri(uri, &at) {
                Some(bytes) => bytes?,
                None => resolver.read(uri).map_err(|source| Error::Read {
                    role: at.clone(),
                    path: container::named(uri),
                    source,
                })?,
            })),
        };
        if let Some(data) = &data
            && (data.len() as u64) < buffer.byte_length.0
        {
            return Err(Error::malformed(
                format!(
                    "{at}.byteLength is {}, but only {} bytes are there",
                    buffer.byte_length.0,
                    data.len()
                ),
                "export or copy the file again",
            ));
        }
        all.push(data);
    }
    Ok(all)
}

/// Node to file coordinates, for the nodes of the scene that is shown; `None` for the others.
fn global_transforms(document: &Document) -> Result<Vec<Option<DMat4>>, Error> {
    let mut globals = vec![None; document.nodes.len()];
    let mut stack: Vec<(usize, DMat4, String)> = Vec::new();
    match document.scene {
        None if document.scenes.is_empty() => {
            let mut is_child = vec![false; document.nodes.len()];
            for child in document.nodes.iter().flat_map(|n| &n.children).flatten() {
                if let Some(flag) = is_child.get_mut(child.value()) {
                    *flag = true;
                }
            }
            for root in (0..document.nodes.len()).rev().filter(|&i| !is_child[i]) {
                stack.push((root, DMat4::IDENTITY, "nodes".into()));
            }
        }
        index => {
            let index = index.map_or(0, |i| i.value());
            let scene = get(&document.scenes, index, "scene", "scenes")?;
            let place = format!("scenes[{index}].nodes");
            for root in scene.nodes.iter().rev() {
                stack.push((root.value(), DMat4::IDENTITY, place.clone()));
            }
        }
    }
    while let Some((index, parent, place)) = stack.pop() {
        let node = get(&document.nodes, index, &place, "nodes")?;
        if globals[index].is_some() {
            return Err(Error::malformed(
                format!("nodes[{index}] is reached twice; a node has one parent"),
                EXPORT,
            ));
        }
        let global = parent * local_transform(&document.placement(index));
        if !global.is_finite() {
            return Err(Error::NotFinite {
                place: "node transforms".into(),
                element: index as u64,
                value: "an entry of the matrix".into(),
            });
        }
        globals[index] = Some(global);
        for child in node.children.iter().flatten().rev() {
            stack.push((child.value(), global, format!("nodes[{index}].children")));
        }
    }
    Ok(globals)
}

fn local_transform(node: &Placement) -> DMat4 {
    if let Some(matrix) = &node.matrix {
        return DMat4::from_cols_array(matrix);
    }
    let rotation = DQuat::from_array(node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]));
    let length = rotation.length();
    DMat4::from_scale_rotation_translation(
        DVec3::from_array(node.scale.unwrap_or([1.0; 3])),
        // Files carry rounded quaternions, and some all zeros.
        if length > 1e-6 && length.is_finite() {
            rotation.normalize()
        } else {
            DQuat::IDENTITY
        },
        DVec3::from_array(node.translation.unwrap_or_default()),
    )
}

/// Copies of a mesh that share their shape.
pub(super) struct Group {
    pub mesh: usize,
    /// The node whose weights or skin make the shape its own.
    pub shaped_by: Option<usize>,
    pub transforms: Vec<DMat4>,
}

/// Where each mesh stands, grouped by shape, in the order of the meshes.
fn instances(
    document: &Document,
    buffers: &Buffers,
    globals: &[Option<DMat4>],
) -> Result<Vec<Group>, Error> {
    let mut groups: BTreeMap<(usize, Option<usize>), Vec<DMat4>> = BTreeMap::new();
    let mut copies = 0;
    for (i, node) in document.nodes.iter().enumerate() {
        let (Some(global), Some(mesh)) = (globals[i], node.mesh) else {
            continue;
        };
        let mesh = mesh.value();
        let place = format!("nodes[{i}].mesh");
        get(&document.meshes, mesh, &place, "meshes")?;
        let own_shape = node.weights.is_some() || node.skin.is_some();
        let instancing = match &node.extensions {
            Some(e) => raw_extension(&e.others, INSTANCING, &format!("nodes[{i}]"))?,
            None => None,
        };
        let transforms = groups.entry((mesh, own_shape.then_some(i))).or_default();
        if node.skin.is_some() {
            // The joints alone place a skinned mesh (glTF 2.0, 3.7.3.3).
            transforms.push(DMat4::IDENTITY);
        } else if let Some(instancing) = instancing {
            let local = gpu_instances(&instancing, i, buffers, MAX_INSTANCES - copies)?;
            copies += local.len() as u64;
            transforms.extend(local.iter().map(|m| global * *m));
        } else {
            transforms.push(global);
        }
    }
    Ok(groups
        .into_iter()
        .map(|((mesh, shaped_by), transforms)| Group {
            mesh,
            shaped_by,
            transforms,
        })
        .collect())
}

/// `EXT_mesh_gpu_instancing`: the copies' transforms relative to the node, `most` of them.
fn gpu_instances(
    instancing: &Instancing,
    index: usize,
    buffers: &Buffers,
    most: u64,
) -> Result<Vec<DMat4>, Error> {
    let at = format!("nodes[{index}].extensions.{INSTANCING}.attributes");
    let mut count = None;
    for (name, &accessor) in &instancing.attributes {
        let n = buffers.accessor(accessor, &format!("{at}.{name}"))?.count.0;
        if n > most {
            return Err(Error::TooLarge {
                what: format!(
                    "{at} has {n} copies, with those before {}",
                    MAX_INSTANCES - most + n
                ),
                limit: MAX_INSTANCES,
            });
        }
        if *count.get_or_insert(n) != n {
            return Err(Error::malformed(
                format!("{at} have different counts"),
                EXPORT,
            ));
        }
    }
    let mut all = vec![(DVec3::ONE, DQuat::IDENTITY, DVec3::ZERO); count.unwrap_or(1) as usize];
    let vector = |[x, y, z]: [f32; 3]| DVec3::new(x.into(), y.into(), z.into());
    for (name, &accessor) in &instancing.attributes {
        let place = format!("{at}.{name}");
        match name.as_str() {
            "TRANSLATION" => {
                let values = buffers.floats(accessor, &place, false, vector)?;
                all.iter_mut().zip(values).for_each(|(i, v)| i.2 = v);
            }
            "SCALE" => {
                let values = buffers.floats(accessor, &place, false, vector)?;
                all.iter_mut().zip(values).for_each(|(i, v)| i.0 = v);
            }
            "ROTATION" => {
                let values = buffers.floats(accessor, &place, true, |[x, y, z, w]| {
                    DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into())
                })?;
                for (instance, q) in all.iter_mut().zip(values) {
                    if q.length() > 1e-6 && q.is_finite() {
                        instance.1 = q.normalize();
                    }
                }
            }
            _ => {}
        }
    }
    let matrices: Vec<_> = all
        .into_iter()
        .map(|(s, r, t)| DMat4::from_scale_rotation_translation(s, r, t))
        .collect();
    match matrices.iter().position(|m| !m.is_finite()) {
        None => Ok(matrices),
        Some(bad) => Err(Error::NotFinite {
            place: at,
            element: bad as u64,
            value: "an entry of the matrix".into(),
        }),
    }
}

/// Expands all copies into one mesh, relative to the returned origin.
fn assemble(
    document: &Document,
    buffers: &Buffers,
    reader: &mut MeshReader,
    groups: Vec<Group>,
    limits: &Limits,
) -> Result<(TriangleMesh, DVec3), Error> {
    let (mut vertices, mut triangles, mut parts) = (0u64, 0u64, 0u64);
    for group in &groups {
        let copies = group.transforms.len() as u64;
        for (p, primitive) in document.meshes[group.mesh].primitives.iter().enumerate() {
            let at = format!("meshes[{}].primitives[{p}]", group.mesh);
            let positions = Checked::Valid(Semantic::Positions);
            let Some(&position) = primitive.attributes.get(&positions) else {
                continue;
            };
            let position = buffers.accessor(position, &format!("{at}.POSITION"))?;
            let count = position.count.0;
            let corners = match primitive.indices {
                Some(i) => buffers.accessor(i, &format!("{at}.indices"))?.count.0,
                None => count,
            };
            let faces = match primitive.mode {
                Checked::Valid(Mode::Triangles) => corners / 3,
                _ => corners.saturating_sub(2),
            };
            vertices = vertices.saturating_add(count.saturating_mul(copies));
            triangles = triangles.saturating_add(faces.saturating_mul(copies));
            parts += copies;
        }
    }
    limits.check(vertices, triangles)?;
    let origin = far_origin(&groups);
    let mut all = TriangleMesh::default();
    for group in groups.iter().filter(|g| !g.transforms.is_empty()) {
        for primitive in 0..document.meshes[group.mesh].primitives.len() {
            let Some(mesh) = reader.read(group, primitive)? else {
                continue;
            };
            let mut mesh = Some(mesh);
            let last = group.transforms.len() - 1;
            for (i, transform) in group.transforms.iter().enumerate() {
                // The last copy takes the original along.
                let copy = if i == last { mesh.take() } else { mesh.clone() };
                let Some(mut copy) = copy else { break };
                copy.transform(&(DMat4::from_translation(-origin) * *transform));
                if let Some(bad) = copy.first_non_finite() {
                    return Err(Error::NotFinite {
                        place: format!(
                            "meshes[{}].primitives[{primitive}].POSITION after the node's transform",
                            group.mesh
                        ),
                        element: bad as u64,
                        value: format!("{:?}", copy.positions[bad].to_array()),
                    });
                }
                limits.check(
                    (all.positions.len() + copy.positions.len()) as u64,
                    (all.indices.len() + copy.indices.len()) as u64,
                )?;
                let first = all.indices.is_empty();
                all.append(copy, 0);
                if first && parts > 1 {
                    all.reserve(vertices as usize, triangles as usize);
                }
            }
        }
    }
    Ok((all, origin))
}

/// Zero unless the first copy stands more than a kilometre out, where single precision resolves
/// less than a tenth of a millimetre; then where it stands.
fn far_origin(groups: &[Group]) -> DVec3 {
    groups
        .iter()
        .find_map(|g| g.transforms.first())
        .map(|m| m.w_axis.truncate())
        .filter(|t| t.length() > 1e3)
        .unwrap_or_default()
}
