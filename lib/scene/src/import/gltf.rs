//! glTF 2.0 and GLB files.
//!
//! The `gltf` crate opens the container and parses the JSON; its readers of accessors are not used.
//! Nothing in a file is trusted: every index, length and offset is checked before it is followed,
//! so that any bytes end in an object or in one error that says where the file is wrong.
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat4, DQuat, DVec3};
use gltf::json::mesh::{Mode, Semantic};
use gltf::json::validation::Checked;
use serde::Deserialize;

use super::accessor::{Buffers, get};
use super::container::{self, Resolver};
use super::document::{Document, Instancing, Placement, raw_extension};
use super::gltf_material::extensions::without_refraction;
use super::gltf_material::{IMAGE_EXTENSIONS, MaterialReader, image_remedy};
use super::gltf_mesh::MeshReader;
use super::{Imported, Limits, lights};
use crate::error::Error;
use crate::material::Material;
use crate::mesh::TriangleMesh;

const EXPORT: &str = "export the file again";

const INSTANCING: &str = "EXT_mesh_gpu_instancing";

const VISIBILITY: &str = "KHR_node_visibility";

/// Extensions that a file may require.
const ACCEPTED: [&str; 22] = [
    INSTANCING,
    VISIBILITY,
    "EXT_meshopt_compression",
    "EXT_texture_webp",
    "KHR_animation_pointer",
    "KHR_lights_punctual",
    "KHR_materials_anisotropy",
    "KHR_materials_clearcoat",
    "KHR_materials_dispersion",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_iridescence",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_sheen",
    "KHR_materials_specular",
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_volume",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "KHR_xmp",
    "KHR_xmp_json_ld",
];

/// What becomes of the look where an extension that a file does not require is not read.
const INSTEAD: [(&str, &str); 5] = [
    ("EXT_lights_ies", "lights of the file are not rendered"),
    ("EXT_lights_image_based", "the photo lights the object"),
    ("KHR_materials_variants", "the default materials are shown"),
    ("MSFT_lod", "the most detailed level is shown"),
    (
        "MSFT_packing_occlusionRoughnessMetallic",
        "the plain textures are used",
    ),
];

/// Reads a glTF or GLB file from memory; `resolver` finds the files that it names.
pub fn load_gltf_bytes(
    bytes: &[u8],
    resolver: &dyn Resolver,
    limits: &Limits,
) -> Result<Imported, Error> {
    let (json, binary) = container::split(bytes)?;
    let document = Document::read(json).map_err(|e| match container::is_gltf_1(json) {
        true => container::old_version("1.0"),
        false => e,
    })?;
    check_header(&document)?;
    let data = buffer_data(&document, binary, resolver)?;
    let buffers = Buffers::new(&document, data, limits);

    let (globals, hidden) = global_transforms(&document)?;
    let groups = instances(&document, &buffers, &globals, &hidden, limits)?;
    let lights = lights::read(&document, &globals, &hidden)?;
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
            remedy: "check that the file's default scene contains a visible mesh",
        });
    }
    warnings.extend(left_out(&document));
    warnings.extend(without_refraction(&list));
    if !lights.is_empty() {
        warnings.push(format!(
            "the file's lights ({}) are not rendered: the light is that of the photo ({})",
            lights.len(),
            lights::LIGHTS
        ));
    }
    if !document.animations.is_empty() {
        warnings.push("animations are ignored: the object stands still in its rest pose".into());
    }
    warnings.append(&mut materials.warnings);
    Imported {
        mesh,
        origin,
        materials: list,
        textures: materials.textures,
        lights,
        warnings,
        dependencies: Vec::new(),
        missing: Vec::new(),
    }
    .checked(limits)
}

/// What the file says and we do not read, one sentence each.
fn left_out(document: &Document) -> Vec<String> {
    let mut names: BTreeSet<&str> = document
        .extensions_used
        .iter()
        .map(String::as_str)
        .collect();
    let root = document.extensions.iter().flat_map(|e| e.others.keys());
    let nodes = document.nodes.iter().filter_map(|n| n.extensions.as_ref());
    let nodes = nodes.flat_map(|e| e.others.keys());
    names.extend(root.chain(nodes).map(String::as_str));
    let mut all = Vec::new();
    for name in names {
        // Extensions of other materials, images and compressed meshes are reported where they are
        // used.
        let reported_elsewhere = name.starts_with("KHR_materials_")
            && name != "KHR_materials_variants"
            || IMAGE_EXTENSIONS.contains(&name)
            || name.contains("compression");
        if reported_elsewhere || ACCEPTED.contains(&name) {
            continue;
        }
        let instead = INSTEAD.iter().find(|(known, _)| *known == name);
        all.push(match instead {
            Some((_, what)) => format!("the extension {name} is not read: {what}"),
            None => format!("the extension {name} is not read"),
        });
    }
    let occluded = |m: &&gltf::json::Material| m.occlusion_texture.is_some();
    let occlusion = document.materials.iter().filter(occluded).count();
    if occlusion > 0 {
        all.push(format!(
            "the occlusion maps of {occlusion} materials are not read: occlusion is simulated"
        ));
    }
    all
}

fn check_header(document: &Document) -> Result<(), Error> {
    let version = &document.asset.version;
    if version.starts_with("1.") {
        return Err(container::old_version(version));
    }
    if !version.starts_with("2.") {
        return Err(Error::malformed(
            format!("asset.version is \"{version}\"; accepted: 2.0"),
            "export the file as glTF 2.0",
        ));
    }
    for name in &document.extensions_required {
        if ACCEPTED.contains(&name.as_str()) {
            continue;
        }
        return Err(not_read(name));
    }
    Ok(())
}

/// The refusal of an extension, with the way out.
pub(super) fn not_read(name: &str) -> Error {
    let remedy = match name {
        "KHR_draco_mesh_compression" => "convert the file: gltf-transform copy IN.glb OUT.glb",
        name if name.contains("compression") => {
            "convert the file: gltf-transform meshopt IN.glb OUT.glb"
        }
        name if IMAGE_EXTENSIONS.contains(&name) => image_remedy(name),
        _ => "export the object without it",
    };
    Error::UnsupportedExtension {
        extension: name.into(),
        remedy,
    }
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
                None => resolver.buffer(uri).map_err(|source| Error::Read {
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

/// `KHR_node_visibility` of a node.
#[derive(Deserialize)]
struct Visibility {
    visible: Option<bool>,
}

/// Node to file coordinates, for the nodes of the scene that is shown, `None` for the others; and
/// which nodes are hidden.
fn global_transforms(document: &Document) -> Result<(Vec<Option<DMat4>>, Vec<bool>), Error> {
    let mut globals = vec![None; document.nodes.len()];
    let mut hidden = vec![false; document.nodes.len()];
    let mut stack: Vec<(usize, DMat4, bool, String)> = Vec::new();
    match document.scene {
        None if document.scenes.is_empty() => {
            let mut is_child = vec![false; document.nodes.len()];
            for child in document.nodes.iter().flat_map(|n| &n.children).flatten() {
                if let Some(flag) = is_child.get_mut(child.value()) {
                    *flag = true;
                }
            }
            for root in (0..document.nodes.len()).rev().filter(|&i| !is_child[i]) {
                stack.push((root, DMat4::IDENTITY, false, "nodes".into()));
            }
        }
        index => {
            let index = index.map_or(0, |i| i.value());
            let scene = get(&document.scenes, index, "scene", "scenes")?;
            let place = format!("scenes[{index}].nodes");
            for root in scene.nodes.iter().rev() {
                stack.push((root.value(), DMat4::IDENTITY, false, place.clone()));
            }
        }
    }
    while let Some((index, parent, parent_hidden, place)) = stack.pop() {
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
        let own: Option<Visibility> = match &node.extensions {
            Some(e) => raw_extension(&e.others, VISIBILITY, &format!("nodes[{index}]"))?,
            None => None,
        };
        let shown = own.and_then(|v| v.visible).unwrap_or(true);
        hidden[index] = parent_hidden || !shown;
        for child in node.children.iter().flatten().rev() {
            let place = format!("nodes[{index}].children");
            stack.push((child.value(), global, hidden[index], place));
        }
    }
    Ok((globals, hidden))
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
    hidden: &[bool],
    limits: &Limits,
) -> Result<Vec<Group>, Error> {
    let mut groups: BTreeMap<(usize, Option<usize>), Vec<DMat4>> = BTreeMap::new();
    let mut copies = 0;
    for (i, node) in document.nodes.iter().enumerate() {
        let (Some(global), Some(mesh), false) = (globals[i], node.mesh, hidden[i]) else {
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
            let local = gpu_instances(&instancing, i, buffers, limits, copies)?;
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

/// `EXT_mesh_gpu_instancing`: the copies' transforms relative to the node; `before` is how many
/// copies other nodes have.
fn gpu_instances(
    instancing: &Instancing,
    index: usize,
    buffers: &Buffers,
    limits: &Limits,
    before: u64,
) -> Result<Vec<DMat4>, Error> {
    let at = format!("nodes[{index}].extensions.{INSTANCING}.attributes");
    let mut count = None;
    for (name, &accessor) in &instancing.attributes {
        let n = buffers.accessor(accessor, &format!("{at}.{name}"))?.count.0;
        limits.check_instances(before.saturating_add(n), &at)?;
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
    limits.check_mesh(vertices, triangles)?;
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
                limits.check_mesh(
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
