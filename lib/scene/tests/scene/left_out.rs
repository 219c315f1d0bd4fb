//! What of a glTF file is honoured, what is left out with a word, and its lights.
use dipir_scene::light::LightKind;
use glam::{DVec3, Vec3};
use serde_json::json;

use crate::glb::{Glb, U8, merge};

#[test]
fn hidden_nodes_and_what_hangs_on_them_are_not_drawn() {
    let hidden = json!({ "KHR_node_visibility": { "visible": false } });
    let mut glb = Glb::triangle(json!({}));
    glb.json["extensionsRequired"] = json!(["KHR_node_visibility"]);
    glb.json["nodes"] = json!([
        { "mesh": 0 },
        { "children": [2, 3], "extensions": hidden, "translation": [0.0, 0.0, 9.0] },
        { "mesh": 0 },
        { "mesh": 0, "extensions": { "KHR_node_visibility": { "visible": true } } },
        { "mesh": 0, "translation": [5.0, 0.0, 0.0], "extensions": { "KHR_node_visibility": {} } },
    ]);
    let mesh = glb.load().mesh;
    assert_eq!(mesh.indices.len(), 2);
    assert_eq!(mesh.bounds().unwrap().1, Vec3::new(6.0, 1.0, 0.0));
    // A hidden joint still holds its vertices.
    let joints = glb.accessor(&[0u8; 12], U8, "VEC4", 3);
    let weights = glb.floats("VEC4", &[1.0, 0.0, 0.0, 0.0].repeat(3));
    merge(
        &mut glb.json["meshes"][0]["primitives"][0]["attributes"],
        json!({ "JOINTS_0": joints, "WEIGHTS_0": weights }),
    );
    glb.push("skins", json!({ "joints": [1] }));
    glb.json["nodes"][0]["skin"] = json!(0);
    assert_eq!(glb.load().mesh.bounds().unwrap().1.z, 9.0);
}

#[test]
fn joints_beyond_the_fourth_hold_a_vertex_too() {
    let mut glb = Glb::triangle(json!({}));
    let first = glb.accessor(&[0u8, 0, 0, 0].repeat(3), U8, "VEC4", 3);
    let second = glb.accessor(&[1u8, 0, 0, 0].repeat(3), U8, "VEC4", 3);
    let weights = glb.floats("VEC4", &[0.25, 0.0, 0.0, 0.0].repeat(3));
    let more = glb.floats("VEC4", &[0.75, 0.0, 0.0, 0.0].repeat(3));
    merge(
        &mut glb.json["meshes"][0]["primitives"][0]["attributes"],
        json!({ "JOINTS_0": first, "WEIGHTS_0": weights, "JOINTS_1": second, "WEIGHTS_1": more }),
    );
    glb.json["nodes"] = json!([
        { "mesh": 0, "skin": 0 },
        { "translation": [0.0, 0.0, 0.0] },
        { "translation": [0.0, 0.0, 4.0] },
    ]);
    glb.push("skins", json!({ "joints": [1, 2] }));
    // A quarter of nothing and three quarters of four metres.
    assert_eq!(glb.load().mesh.positions[0].z, 3.0);
}

#[test]
fn what_is_not_read_is_named_once_each() {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    let color = glb.floats("VEC4", &[1.0; 12]);
    glb.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_1"] = json!(color);
    glb.json["extensionsUsed"] = json!([
        "KHR_materials_variants",
        "KHR_mesh_quantization",
        "EXT_texture_transform",
        "EXT_lights_image_based",
    ]);
    // Not announced, but there.
    glb.json["nodes"][0]["extensions"] = json!({ "MSFT_lod": { "ids": [] } });
    glb.push("images", json!({ "uri": "gone.png" }));
    glb.push("textures", json!({ "source": 0 }));
    glb.push("materials", json!({ "occlusionTexture": { "index": 0 } }));
    assert_eq!(
        glb.load().warnings,
        [
            "meshes[0].primitives[0]: COLOR_1 is not read; only COLOR_0 is part of the surface",
            "the extension EXT_lights_image_based is not read: the photo lights the object",
            "the extension EXT_texture_transform is not read",
            "the extension KHR_materials_variants is not read: the default materials are shown",
            "the extension MSFT_lod is not read: the most detailed level is shown",
            "the occlusion maps of 1 materials are not read: occlusion is simulated",
        ]
    );
}

/// A triangle and three lights, turned and moved by their nodes.
fn lit() -> Glb {
    let mut glb = Glb::triangle(json!({}));
    glb.json["extensionsRequired"] = json!(["KHR_lights_punctual"]);
    glb.json["extensions"] = json!({ "KHR_lights_punctual": { "lights": [
        { "type": "directional", "intensity": 1000.0, "color": [1.0, 0.5, 0.0], "name": "sun" },
        { "type": "point", "range": 5.0 },
        { "type": "spot", "intensity": 40.0, "spot": { "innerConeAngle": 0.25 } },
    ] } });
    let node = |light: u32| json!({ "KHR_lights_punctual": { "light": light } });
    let half = 0.5f64.sqrt();
    for node in [
        // A quarter turn about x sends -z to +y, minus that to -y.
        json!({ "extensions": node(0), "rotation": [-half, 0.0, 0.0, half] }),
        json!({ "extensions": node(1), "translation": [1.0, 2.0, 3.0] }),
        json!({ "extensions": node(2), "translation": [0.0, 4.0, 0.0], "scale": [2.0, 2.0, 2.0] }),
    ] {
        glb.push("nodes", node);
    }
    glb
}

#[test]
fn lights_arrive_with_place_direction_and_unit_and_are_said_not_to_be_rendered() {
    let imported = lit().load();
    let [sun, bulb, spot] = &imported.lights[..] else {
        panic!("three lights");
    };
    assert_eq!(
        (sun.kind, sun.name.as_str()),
        (LightKind::Directional, "sun")
    );
    assert_eq!(
        (sun.intensity, sun.color),
        (1000.0, Vec3::new(1.0, 0.5, 0.0))
    );
    // Sine and cosine of a quarter turn, rounded.
    assert!((sun.direction - DVec3::NEG_Y).length() < 4.0 * f64::EPSILON);
    assert_eq!((bulb.kind, bulb.intensity), (LightKind::Point, 1.0));
    assert_eq!(
        (bulb.range, bulb.position),
        (Some(5.0), DVec3::new(1.0, 2.0, 3.0))
    );
    let cone = LightKind::Spot {
        inner_cone_rad: 0.25,
        outer_cone_rad: std::f32::consts::FRAC_PI_4,
    };
    assert_eq!((spot.kind, spot.direction), (cone, DVec3::NEG_Z));
    assert_eq!(
        imported.warnings,
        [
            "the file's lights (3) are not rendered: the light is that of the photo (KHR_lights_punctual)"
        ]
    );
}

#[test]
fn lights_that_make_no_sense_are_refused() {
    for (change, expected) in [
        (
            json!({ "type": "area" }),
            "the light of nodes[1].extensions.KHR_lights_punctual.light has the type \"area\"; accepted: directional, point, spot; export the file again",
        ),
        (
            json!({ "intensity": -1.0 }),
            "the light of nodes[1].extensions.KHR_lights_punctual.light has a colour, intensity or range that is negative or not finite; export the file again",
        ),
        (
            json!({ "type": "spot", "spot": { "outerConeAngle": 3.0 } }),
            "the light of nodes[1].extensions.KHR_lights_punctual.light has a cone from 0 to 3; accepted: 0 <= inner < outer <= pi/2; export the file again",
        ),
    ] {
        let mut glb = lit();
        merge(
            &mut glb.json["extensions"]["KHR_lights_punctual"]["lights"][0],
            change,
        );
        assert_eq!(glb.try_load().unwrap_err().to_string(), expected);
    }
    let mut glb = lit();
    glb.json["nodes"][2]["extensions"]["KHR_lights_punctual"]["light"] = json!(3);
    assert_eq!(
        glb.try_load().unwrap_err().to_string(),
        "nodes[2].extensions.KHR_lights_punctual.light is 3, but the file has 3 lights; export the file again"
    );
}

#[test]
fn placing_an_object_places_its_lights() {
    use glam::DMat4;
    let spot = &lit().load().lights[1];
    let map = DMat4::from_translation(DVec3::X) * DMat4::from_scale(DVec3::splat(2.0));
    let placed = spot.placed(&map);
    assert_eq!(placed.position, DVec3::new(3.0, 4.0, 6.0));
    assert_eq!((placed.range, placed.intensity), (Some(10.0), 1.0));
}
