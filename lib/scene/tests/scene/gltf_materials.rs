//! What a glTF file says of materials and textures is what arrives.
use dipir_scene::material::AlphaMode;
use dipir_scene::texture::{Filter, Wrap, decode_textures};
use glam::{Vec2, Vec3, Vec4};
use serde_json::json;

use crate::glb::Glb;
use crate::gltf_import::{ROUNDING, normal_mapped_square};

#[test]
fn specular_glossiness_stands_in_only_for_a_missing_model() {
    let old = json!({ "KHR_materials_pbrSpecularGlossiness": {
        "diffuseFactor": [0.1, 0.2, 0.3, 1.0], "glossinessFactor": 0.75, "specularFactor": [0.9, 0.7, 0.3],
    } });
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push("materials", json!({ "extensions": old }));
    let imported = glb.load();
    let material = &imported.materials[0];
    assert_eq!(material.base_color, Vec4::new(0.1, 0.2, 0.3, 1.0));
    assert_eq!((material.metallic, material.roughness), (0.0, 0.25));
    // What a metal of this model reflects is its specular colour alone.
    let specular = material.extensions.specular.unwrap();
    let reflected = ((material.ior - 1.0) / (material.ior + 1.0)).powi(2) * specular.color;
    let wrong = (reflected - Vec3::new(0.9, 0.7, 0.3)).abs();
    // The index of a surface that reflects nearly all has some digits fewer.
    assert!(wrong.max_element() < 1e-5, "{reflected}");
    assert!(imported.warnings.is_empty(), "{:?}", imported.warnings);
    let specular = "/materials/0/extensions/KHR_materials_pbrSpecularGlossiness/specularFactor";
    *glb.json.pointer_mut(specular).unwrap() = json!([0.04, 0.04, 0.04]);
    let plain = &glb.load().materials[0];
    assert!((plain.ior - 1.5).abs() < 1e-5 && plain.extensions.specular.is_none());
    glb.json["materials"][0]["pbrMetallicRoughness"] = json!({});
    let material = &glb.load().materials[0];
    assert_eq!(material.base_color, Vec4::ONE);
    assert_eq!((material.metallic, material.roughness), (1.0, 1.0));
    assert!(material.extensions.specular.is_none());
}

#[test]
fn material_parameters_and_extensions_arrive() {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push(
        "materials",
        json!({
            "name": "all",
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.1, 0.2, 0.3, 0.4], "metallicFactor": 0.5, "roughnessFactor": 0.25
            },
            "emissiveFactor": [1.0, 0.5, 0.0],
            "alphaMode": "MASK", "alphaCutoff": 0.75, "doubleSided": true,
            "extensions": {
                "KHR_materials_emissive_strength": { "emissiveStrength": 8.0 },
                "KHR_materials_clearcoat": { "clearcoatFactor": 0.9, "clearcoatRoughnessFactor": 0.1 },
                "KHR_materials_transmission": { "transmissionFactor": 0.7 },
                "KHR_materials_ior": { "ior": 1.33 },
                "KHR_materials_sheen": {},
                "KHR_materials_dispersion": { "dispersion": 0.1 },
            },
        }),
    );
    let imported = glb.load();
    let m = &imported.materials[0];
    assert_eq!(m.name, "all");
    assert_eq!(m.base_color, Vec4::new(0.1, 0.2, 0.3, 0.4));
    assert_eq!((m.metallic, m.roughness, m.ior), (0.5, 0.25, 1.33));
    assert_eq!(m.emissive, Vec3::new(8.0, 4.0, 0.0));
    assert_eq!(m.alpha_mode, AlphaMode::Mask { cutoff: 0.75 });
    assert!(m.double_sided && !m.unlit);
    let coat = m.clearcoat.unwrap();
    assert_eq!((coat.factor, coat.roughness), (0.9, 0.1));
    assert_eq!(m.transmission.unwrap().factor, 0.7);
    assert_eq!(
        imported.warnings,
        ["materials[0]: KHR_materials_dispersion not supported and left out"]
    );
}

#[test]
fn the_refraction_of_solids_is_said_to_be_left_out_once() {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    let mut material = |name: &str, ior: f32, thickness: f32, transmission: f32| {
        glb.push(
            "materials",
            json!({ "name": name, "extensions": {
                "KHR_materials_transmission": { "transmissionFactor": transmission },
                "KHR_materials_ior": { "ior": ior },
                "KHR_materials_volume": { "thicknessFactor": thickness },
            } }),
        );
    };
    material("glass", 1.5, 0.1, 1.0);
    material("sheet", 1.5, 0.0, 1.0);
    material("fog", 1.0, 0.1, 1.0);
    material("opaque", 1.5, 0.1, 0.0);
    material("", 1.33, 0.1, 0.5);
    let warning = |names: &str| {
        format!(
            "the refraction of the solid {names} (KHR_materials_volume) is left out: light is attenuated there, but goes straight on"
        )
    };
    assert_eq!(glb.load().warnings, [warning("\"glass\", materials[4]")]);
    for i in 5..10 {
        let copy = glb.json["materials"][4].clone();
        assert_eq!(glb.push("materials", copy), i);
    }
    let names = "\"glass\", materials[4], materials[5], materials[6], materials[7] and 2 more";
    assert_eq!(glb.load().warnings, [warning(names)]);
}

#[test]
fn extensions_of_the_reflection_arrive_and_those_without_effect_do_not() {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push(
        "materials",
        json!({ "extensions": {
            "KHR_materials_specular": { "specularFactor": 0.5, "specularColorFactor": [2.0, 1.0, 0.5] },
            "KHR_materials_sheen": { "sheenColorFactor": [0.1, 0.2, 0.3], "sheenRoughnessFactor": 0.4 },
            "KHR_materials_anisotropy": { "anisotropyStrength": 0.6, "anisotropyRotation": 1.5 },
            "KHR_materials_iridescence": { "iridescenceFactor": 0.7, "iridescenceThicknessMaximum": 500.0 },
            "KHR_materials_volume": {
                "thicknessFactor": 0.2, "attenuationDistance": 3.0, "attenuationColor": [1.0, 0.5, 0.0]
            },
        } }),
    );
    let imported = glb.load();
    let e = imported.materials[0].extensions;
    let (specular, sheen) = (e.specular.unwrap(), e.sheen.unwrap());
    assert_eq!(specular.factor, 0.5);
    assert_eq!(specular.color, Vec3::new(2.0, 1.0, 0.5));
    assert_eq!(
        (sheen.color, sheen.roughness),
        (Vec3::new(0.1, 0.2, 0.3), 0.4)
    );
    let anisotropy = e.anisotropy.unwrap();
    assert_eq!((anisotropy.strength, anisotropy.rotation_rad), (0.6, 1.5));
    let film = e.iridescence.unwrap();
    assert_eq!(
        (film.factor, film.ior, film.thickness_nm),
        (0.7, 1.3, [100.0, 500.0])
    );
    let volume = e.volume.unwrap();
    assert_eq!((volume.thickness, volume.attenuation_distance), (0.2, 3.0));
    assert_eq!(volume.attenuation_color, Vec3::new(1.0, 0.5, 1e-6));
    assert!(imported.warnings.is_empty(), "{:?}", imported.warnings);

    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push(
        "materials",
        json!({ "extensions": {
            "KHR_materials_specular": {}, "KHR_materials_sheen": {}, "KHR_materials_anisotropy": {},
            "KHR_materials_iridescence": {}, "KHR_materials_volume": {},
        } }),
    );
    let imported = glb.load();
    assert!(imported.materials[0].extensions.is_empty());
    assert!(imported.warnings.is_empty());
}

#[test]
fn a_primitive_without_material_gets_the_default_one() {
    let mut glb = Glb::triangle(json!({}));
    glb.push("materials", json!({ "name": "unused" }));
    let imported = glb.load();
    assert_eq!(imported.mesh.materials, [1]);
    let default = &imported.materials[1];
    assert_eq!((default.metallic, default.roughness), (1.0, 1.0));
}

#[test]
fn texture_transforms_scale_then_rotate_then_shift() {
    let mut glb = normal_mapped_square(&[0.0; 8]);
    let second = glb.floats("VEC2", &[0.25; 8]);
    glb.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_1"] = json!(second);
    let (offset, rotation, scale) = ([0.1, 0.2], 0.3f32, [2.0, 3.0]);
    glb.json["materials"][0]["normalTexture"]["extensions"] = json!({ "KHR_texture_transform": {
        "offset": offset, "rotation": rotation, "scale": scale, "texCoord": 1
    } });
    let imported = glb.load();
    let (texture, _) = imported.materials[0].normal_texture.unwrap();
    assert_eq!(texture.uv_set, 1);
    assert!(
        imported.mesh.uvs[0].is_empty(),
        "a set that nobody reads is not kept"
    );
    assert_eq!(imported.mesh.uvs[1].len(), 4);
    let (u, v) = (0.4f32 * 2.0, 0.7f32 * 3.0);
    let (s, c) = rotation.sin_cos();
    // The extension's rotation is counter-clockwise as the image is seen, v pointing down.
    let expected = Vec2::new(c * u + s * v + 0.1, -s * u + c * v + 0.2);
    assert!((texture.apply(Vec2::new(0.4, 0.7)) - expected).length() < 2.0 * ROUNDING);
}

#[test]
fn samplers_arrive_and_images_are_decoded_only_on_demand() {
    let mut glb = normal_mapped_square(&[0.0; 8]);
    glb.push(
        "samplers",
        json!({ "magFilter": 9728, "wrapS": 33071, "wrapT": 33648 }),
    );
    glb.json["textures"][0]["sampler"] = json!(0);
    // The same image, read as colour, is another texture.
    glb.json["materials"][0]["pbrMetallicRoughness"] =
        json!({ "baseColorTexture": { "index": 0 } });
    let imported = glb.load();
    assert_eq!(imported.textures.len(), 2);
    let texture = &imported.textures[0];
    assert_eq!(texture.wrap, [Wrap::ClampToEdge, Wrap::MirroredRepeat]);
    assert_eq!(texture.filter, Filter::Nearest);
    let decoded = decode_textures(&imported.textures, |i| i == 1).unwrap();
    assert!(decoded[0].is_none());
    let linear = decoded[1].as_ref().unwrap().sample(Vec2::splat(0.5));
    // 0.5 is stored as byte 128.
    assert!((linear.x - 128.0 / 255.0).abs() < ROUNDING);
}
