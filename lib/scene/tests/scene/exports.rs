//! OBJ files, and what belongs to them, as exporters and file systems make them.
use std::path::PathBuf;

use dipir_scene::import::{Imported, Limits, load_object, load_ply_bytes};
use dipir_scene::material::AlphaMode;
use glam::{DVec3, Vec3, Vec4};
use serde_json::json;
use tempfile::TempDir;

use crate::glb::{Glb, one_texel_png};

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

struct Project(TempDir);

impl Project {
    /// A folder with these files.
    fn with(files: &[(&str, &[u8])]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        for (name, bytes) in files {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, bytes).unwrap();
        }
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn load(&self, name: &str) -> Imported {
        load_object(&self.path(name)).unwrap()
    }

    /// A square with the material `a` of this library.
    fn material(statements: &[u8]) -> Imported {
        let mesh = format!("mtllib m.mtl\n{SQUARE}usemtl a\nf 1 2 3\n");
        let library = [b"newmtl a\n", statements].concat();
        let paint = one_texel_png([1.0, 0.0, 0.0]);
        let files: [(&str, &[u8]); 3] = [
            ("m.obj", mesh.as_bytes()),
            ("m.mtl", &library),
            ("paint.png", &paint),
        ];
        Self::with(&files).load("m.obj")
    }
}

#[test]
fn a_library_may_be_named_after_its_materials_are_used() {
    let red = b"newmtl red\nKd 1 0 0\n";
    let mesh = format!(
        "{SQUARE}usemtl red\nf 1 2 3\nusemtl blue\nf 2 3 4\nmtllib m.mtl\nusemtl red\nf 1 3 4\n"
    );
    let project = Project::with(&[("m.obj", mesh.as_bytes()), ("m.mtl", red)]);
    let imported = project.load("m.obj");
    assert_eq!(imported.mesh.materials, [0, 1, 0]);
    assert_eq!(
        imported.materials[0].base_color,
        Vec4::new(1.0, 0.0, 0.0, 1.0)
    );
    assert_eq!(
        imported.warnings,
        ["material \"blue\" is not defined; grey is used"]
    );
}

#[test]
fn colours_of_xyz_are_converted_and_spectra_left_out() {
    // D65, of luminance one half.
    let white = Project::material(b"Kd xyz 0.47523 0.5 0.54453\nKe xyz 0.4124 0.2126 0.0193\n");
    let material = &white.materials[0];
    // The matrix has seven digits, the numbers here have four.
    let near =
        |found: Vec3, want: Vec3| assert!((found - want).abs().max_element() < 2e-4, "{found}");
    near(material.base_color.truncate(), Vec3::splat(0.5));
    near(material.emissive, Vec3::X);
    assert!(white.warnings.is_empty());
    let spectral = Project::material(b"Kd spectral skin.rfl 1.0\nKs spectral a.rfl\nNs 30\n");
    assert_eq!(
        spectral.warnings,
        ["material \"a\": Kd spectral, Ks spectral not supported and left out"]
    );
    // The rest is read.
    assert!((spectral.materials[0].roughness - 0.5).abs() < f32::EPSILON);
}

#[test]
fn a_texture_is_seen_as_it_is_without_a_colour_before_or_behind_it() {
    for statements in [
        "map_Kd paint.png\n",
        "map_Kd paint.png\nKd 0 0 0\n",
        "Kd 0 0 0\nmap_Kd paint.png\n",
    ] {
        let imported = Project::material(statements.as_bytes());
        assert_eq!(imported.materials[0].base_color, Vec4::ONE, "{statements}");
    }
    let glow = Project::material(b"map_Ke paint.png\nKe 0 0 0\n");
    assert_eq!(glow.materials[0].emissive, Vec3::ONE);
    let small = Project::material(b"kd 0.5 0.25 0.5\nmap_kd paint.png\nmap_bump paint.png\n");
    let small = &small.materials[0];
    assert_eq!(small.base_color.y, 0.25);
    assert!(small.base_color_texture.is_some() && small.normal_texture.is_some());
    let dimmed = Project::material(b"map_Kd paint.png\nKd 0.5 0.5 0.5\n");
    assert_eq!(dimmed.materials[0].base_color.x, 0.5);
}

#[test]
fn what_refracts_and_is_opaque_otherwise_is_glass_and_what_exporters_write_of_every_surface_is_not()
{
    // Maya's of an opaque surface, Blender's of those that `d` makes transparent, a map that does.
    for statements in [
        "illum 4\nTf 1.00 1.00 1.00\nNi 1\n",
        "illum 9\nd 0.5\n",
        "illum 6\nd 0.5\n",
        "Tr 0.5\nillum 7\nNi 1.5\n",
        "illum 7\nmap_d paint.png\n",
        "illum 2\nTf 0 0 0\n",
    ] {
        let imported = Project::material(statements.as_bytes());
        let told = imported
            .warnings
            .iter()
            .filter(|w| !w.contains("coordinates"));
        assert_eq!(told.count(), 0, "{:?}", imported.warnings);
        assert_eq!(imported.materials[0].transmission, None, "{statements}");
    }
    let coloured = Project::material(b"Tf 0.3 0.3 0.3\nillum 4\n");
    assert_eq!(coloured.materials[0].transmission, None);
    let told = ["material \"a\": Tf not supported and left out"];
    assert_eq!(coloured.warnings, told);
    // Paint of which an exporter says 7, as of every surface.
    for paint in ["Kd 0.8 0.1 0.1\nNi 1\n", "Ni 1.5\nmap_Kd paint.png\n"] {
        let painted = Project::material(format!("{paint}illum 7\n").as_bytes());
        assert_eq!(painted.materials[0].transmission, None, "{paint}");
        let told = &painted.warnings.join("\n");
        assert!(
            told.contains("illum 7 (refraction) not supported"),
            "{told}"
        );
    }
    for (statements, color, ior, roughness) in [
        (
            "illum 7\nTf 0.9 1 0.8\nNi 1.33\nd 1\nKd 0 0 0\nNs 200\n",
            Vec4::new(0.9, 1.0, 0.8, 1.0),
            1.33,
            0.0,
        ),
        (
            "Kd 0.01 0.01 0.01\nillum 6\nNi 1.45\nTf 1 1 1\nPr 0.25\n",
            Vec4::ONE,
            1.45,
            0.25,
        ),
    ] {
        let imported = Project::material(statements.as_bytes());
        let glass = &imported.materials[0];
        assert_eq!(glass.transmission.unwrap().factor, 1.0);
        assert_eq!(
            (glass.base_color, glass.ior, glass.roughness),
            (color, ior, roughness)
        );
        assert_eq!(glass.alpha_mode, AlphaMode::Opaque);
        let [told] = &imported.warnings[..] else {
            panic!("{:?}", imported.warnings);
        };
        assert!(told.ends_with("that light passes straight: its refraction is left out"));
    }
}

#[test]
fn names_with_a_hash_are_whole_whatever_the_case_of_the_statement() {
    let mesh = format!("mtllib m.mtl\n{SQUARE}vt 0 0\nusemtl Material #25\nf 1/1 2/1 3/1\n");
    let library = b"NEWMTL Material #25\nMAP_KD a#b.png # paint\nKD 1 1 1 # white\n";
    let paint = one_texel_png([1.0, 0.0, 0.0]);
    let files: [(&str, &[u8]); 3] = [
        ("m.obj", mesh.as_bytes()),
        ("m.mtl", library),
        ("a#b.png", &paint),
    ];
    let imported = Project::with(&files).load("m.obj");
    assert_eq!(imported.warnings, [""; 0]);
    assert_eq!(imported.materials[0].name, "Material #25");
    assert!(imported.materials[0].base_color_texture.is_some());
}

#[test]
fn a_library_named_by_its_place_on_another_machine_is_found_beside_the_object() {
    for named in [
        "C:\\work\\my chair.mtl",
        "/home/a/my chair.mtl",
        "../lib/my chair.mtl",
    ] {
        let mesh = format!("mtllib {named}\n{SQUARE}vt 0 0\nusemtl a\nf 1/1 2/1 3/1\n");
        let paint = one_texel_png([1.0, 0.0, 0.0]);
        let files: [(&str, &[u8]); 3] = [
            ("m.obj", mesh.as_bytes()),
            ("my chair.mtl", b"newmtl a\nmap_Kd paint.png\n"),
            ("paint.png", &paint),
        ];
        let imported = Project::with(&files).load("m.obj");
        assert_eq!(imported.warnings, [""; 0], "{named}");
        assert!(imported.materials[0].base_color_texture.is_some());
    }
}

#[test]
fn the_polypaint_of_zbrush_is_read_where_vertices_have_no_colours_of_their_own() {
    let faces = "#MRGB ffff0000ff00ff00\n#MRGB ff0000ffgarbage!\nf -4 -3 -2\nf 1 3 4\n";
    let project = Project::with(&[
        ("m.obj", format!("{SQUARE}{faces}").as_bytes()),
        (
            "own.obj",
            format!("{}{faces}", SQUARE.replace(" 0\n", " 0 0 0 0\n")).as_bytes(),
        ),
    ]);
    let imported = project.load("m.obj");
    let [red, green, blue] = [Vec3::X, Vec3::Y, Vec3::Z].map(|c| c.extend(1.0));
    // What is no colour is white, as what has none.
    assert_eq!(imported.mesh.colors, [red, green, blue, Vec4::ONE]);
    let own = project.load("own.obj").mesh.colors;
    assert_eq!(own, [Vec4::new(0.0, 0.0, 0.0, 1.0); 4]);
}

#[test]
fn names_in_latin_1_are_told_apart() {
    let mesh =
        b"mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nusemtl \xe4\nf 1/1 2/1 3/1\nusemtl \xf6\nf 1 2 3\n";
    let library = b"newmtl \xe4\nKd 1 0 0\nmap_Kd holz_\xe4.png\nnewmtl \xf6\nKd 0 1 0\n";
    let paint = one_texel_png([1.0, 0.0, 0.0]);
    let project = Project::with(&[("m.obj", mesh), ("m.mtl", library), ("holz_ä.png", &paint)]);
    let imported = project.load("m.obj");
    assert_eq!(imported.mesh.materials, [0, 1]);
    assert!(imported.warnings.is_empty(), "{:?}", imported.warnings);
    assert!(imported.materials[0].base_color_texture.is_some());
}

#[test]
fn files_whose_names_differ_in_case_alone_are_found_and_told() {
    let mesh = format!("mtllib Car.MTL\n{SQUARE}vt 0 0\nusemtl a\nf 1/1 2/1 3/1\n");
    let library = b"newmtl a\nmap_Kd Textures\\Paint.PNG\n";
    let paint = one_texel_png([1.0, 0.0, 0.0]);
    let project = Project::with(&[
        ("car.obj", mesh.as_bytes()),
        ("car.mtl", library),
        ("textures/paint.png", &paint),
    ]);
    let imported = project.load("car.obj");
    // Other systems find them by any case.
    if project.path("CAR.OBJ").exists() {
        return;
    }
    assert!(imported.materials[0].base_color_texture.is_some());
    assert_eq!(
        imported.warnings,
        [
            "there is no \"Car.MTL\"; \"car.mtl\" is used, whose name differs in the case of letters",
            "there is no \"Textures/Paint.PNG\"; \"textures/paint.png\" is used, whose name differs in the case of letters",
        ]
    );
    let found = ["car.mtl", "textures/paint.png"].map(|name| project.path(name));
    assert_eq!(imported.dependencies, found);
    // Once a file has the very name, it is that one.
    let looked_for = ["Car.MTL", "Textures/Paint.PNG"].map(|name| project.path(name));
    assert_eq!(imported.missing, looked_for);
    std::fs::write(project.path("Car.MTL"), "newmtl a\nKd 0 1 0\n").unwrap();
    let exact = project.load("car.obj");
    assert_eq!(exact.materials[0].base_color.x, 0.0);
    assert!(exact.warnings.is_empty() && exact.missing.is_empty());
    // Of two nobody can say which.
    std::fs::remove_file(project.path("Car.MTL")).unwrap();
    std::fs::write(project.path("CAR.mtl"), "newmtl a\nKd 0 0 1\n").unwrap();
    let neither = project.load("car.obj");
    assert!(neither.warnings[0].starts_with("material library \"Car.MTL\" cannot be read"));
}

#[test]
fn buffers_and_images_of_gltf_are_found_by_another_case_and_an_empty_name_is_told() {
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push("images", json!({ "uri": "PAINT.png" }));
    glb.push("textures", json!({ "source": 0 }));
    let texture = json!({ "baseColorTexture": { "index": 0 } });
    glb.push("materials", json!({ "pbrMetallicRoughness": texture }));
    let paint = one_texel_png([1.0, 0.0, 0.0]);
    let bytes = glb.bytes();
    let project = Project::with(&[("sub/car.glb", &bytes), ("sub/paint.png", &paint)]);
    if project.path("SUB").exists() {
        return;
    }
    let imported = project.load("sub/car.glb");
    assert!(imported.materials[0].base_color_texture.is_some());
    assert_eq!(imported.dependencies, [project.path("sub/paint.png")]);
    glb.json["images"][0]["uri"] = json!("");
    std::fs::write(project.path("sub/car.glb"), glb.bytes()).unwrap();
    assert_eq!(
        project.load("sub/car.glb").warnings,
        [
            "the texture images[0] \"\" cannot be read (no file is named); the material's factors alone are used"
        ]
    );
}

#[test]
fn concave_faces_of_obj_and_ply_are_not_filled() {
    let arrow = "v 1 2 0\nv 0 1 0\nv -1 2 0\nv 0 0 0\nf 1 2 3 4\n";
    let project = Project::with(&[("arrow.obj", arrow.as_bytes())]);
    let header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n\
                  element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    let ply = format!("{header}1 2 0\n0 1 0\n-1 2 0\n0 0 0\n4 0 1 2 3\n");
    let ply = load_ply_bytes(ply.as_bytes(), &Limits::default()).unwrap();
    for mesh in [project.load("arrow.obj").mesh, ply.mesh] {
        let areas: Vec<f64> = (0..2).map(|t| 0.5 * mesh.scaled_normal(t).z).collect();
        assert_eq!(areas, [0.5, 0.5]);
    }
}

#[test]
fn objects_in_the_coordinates_of_a_map_keep_their_millimetres() {
    let far = "v 500123.401 12.5 5400321.702\nv 500123.403 12.5 5400321.702\nv 500123.403 12.5 5400321.705\nf 1 2 3\n";
    let project = Project::with(&[("far.obj", far.as_bytes())]);
    let header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n\
                  element face 1\nproperty list uchar int vertex_indices\nend_header\n";
    let rows = far.replace("v ", "").replace("f 1 2 3", "3 0 1 2");
    let ply = load_ply_bytes(format!("{header}{rows}").as_bytes(), &Limits::default()).unwrap();
    for imported in [project.load("far.obj"), ply] {
        assert_eq!(imported.origin, DVec3::new(500123.401, 12.5, 5400321.702));
        let want = [[0.0, 0.0, 0.0], [0.002, 0.0, 0.0], [0.002, 0.0, 0.003]];
        for (found, want) in imported.mesh.positions.iter().zip(want) {
            // Double precision of five million has steps of 1e-9.
            assert!(found.distance(Vec3::from_array(want)) < 1e-8, "{found}");
        }
    }
    let near = Project::with(&[("near.obj", b"v 9999 0 0\nv 1e6 0 0\nv 0 1 0\nf 1 2 3\n")]);
    let near = near.load("near.obj");
    assert_eq!((near.origin, near.mesh.positions[1].x), (DVec3::ZERO, 1e6));
}

#[test]
fn a_face_of_two_corners_is_left_out_and_the_others_are_drawn() {
    let mesh = format!("{SQUARE}f 1 2\nf 1 2 3\n");
    let imported = Project::with(&[("m.obj", mesh.as_bytes())]).load("m.obj");
    assert_eq!(imported.mesh.indices.len(), 1);
    assert_eq!(
        imported.warnings,
        ["faces of fewer than three corners are not drawn"]
    );
}

#[test]
fn normals_that_are_no_numbers_are_repaired() {
    let mesh = format!("{SQUARE}vn -1.#IND00 -1.#IND00 -1.#IND00\nvn 0 0 1 #.\nf 1//1 2//1 3//2\n");
    let imported = Project::with(&[("m.obj", mesh.as_bytes())]).load("m.obj");
    assert_eq!(imported.mesh.normals, [Vec3::Z; 3]);
    assert_eq!(
        imported.warnings,
        ["2 normals were missing or broken and are computed from the triangles"]
    );
}

#[test]
fn colours_of_ply_may_be_bytes_in_floats_and_those_of_faces_are_told() {
    let head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
    let colored = "property float red\nproperty float green\nproperty float blue\n";
    let face = "element face 1\nproperty list uchar int vertex_indices\n";
    let load = |text: String| load_ply_bytes(text.as_bytes(), &Limits::default()).unwrap();
    let bytes = load(format!(
        "{head}{colored}{face}end_header\n0 0 0 255 0 0\n1 0 0 255 0 0\n0 1 0 0 0 255\n3 0 1 2\n"
    ));
    let (red, blue) = (Vec4::new(1.0, 0.0, 0.0, 1.0), Vec4::new(0.0, 0.0, 1.0, 1.0));
    assert_eq!(bytes.mesh.colors, [red, red, blue]);
    let faces = load(format!(
        "{head}{face}property uchar red\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 255\n"
    ));
    assert!(faces.warnings[0].starts_with("colours of faces are not read"));
}

#[test]
fn a_texture_that_is_a_folder_or_an_address_elsewhere_is_missing_and_refuses_nothing() {
    let load = |address: &str| {
        let mesh = format!("mtllib sub/m.mtl\n{SQUARE}vt 0 0\nusemtl a\nf 1/1 2/1 3/1\n");
        let library = format!("newmtl a\nmap_Kd {address}\n");
        let paint = one_texel_png([1.0, 0.0, 0.0]);
        let files: [(&str, &[u8]); 4] = [
            ("m.obj", mesh.as_bytes()),
            ("sub/m.mtl", library.as_bytes()),
            ("paint.png", &paint),
            ("sub/tex/other.png", &paint),
        ];
        Project::with(&files).load("m.obj")
    };
    for (address, reason) in [
        ("tex/", "a folder, not a regular file"),
        ("/home/artist/gone.png", "it lies outside of"),
        ("file:///home/artist/gone.png", "it lies outside of"),
        (
            "https://example.org/gone.png",
            "https addresses are not followed",
        ),
    ] {
        let told = load(address).warnings;
        assert!(
            told.len() == 1 && told[0].contains(reason),
            "{address}: {told:?}"
        );
        assert!(told[0].ends_with("the material's factors alone are used"));
    }
    for address in [
        "/home/artist/paint.png",
        "file:///home/artist/paint.png",
        "FILE://localhost/C:/paint.png",
        "file:\\\\\\C:\\artist\\paint.png",
        "file://paint.png",
    ] {
        let imported = load(address);
        assert!(imported.warnings.is_empty(), "{:?}", imported.warnings);
        assert_eq!(imported.textures.len(), 1, "{address}");
    }
}

#[test]
fn an_opacity_map_of_its_own_becomes_the_alpha_of_the_colours() {
    let png = |pixels: &[[u8; 4]], width: u32| {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let height = pixels.len() as u32 / width;
        let image = image::RgbaImage::from_raw(width, height, pixels.as_flattened().to_vec());
        let image = image.unwrap();
        image.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    };
    let paint = png(&[[200, 0, 0, 255], [0, 100, 0, 255]], 2);
    // Twice as large in both directions.
    let mask = png(&[0u8, 60, 120, 255, 1, 2, 3, 4].map(|v| [v, v, v, 255]), 4);
    let leaf = png(&[[9, 9, 9, 30], [9, 9, 9, 255]], 2);
    let load = |statements: &str| {
        let mesh = format!("mtllib m.mtl\n{SQUARE}vt 0 0\nusemtl a\nf 1/1 2/1 3/1\n");
        let library = format!("newmtl a\n{statements}newmtl b\n{statements}");
        let files: [(&str, &[u8]); 6] = [
            ("m.obj", mesh.as_bytes()),
            ("m.mtl", library.as_bytes()),
            ("paint.png", &paint),
            ("mask.png", &mask),
            ("leaf.png", &leaf),
            ("leaf.tga", b"targa"),
        ];
        let project = Project::with(&files);
        let imported = project.load("m.obj");
        let texels = |material: usize| {
            let texture = imported.materials[material].base_color_texture?.texture;
            let decoded = imported.textures[texture as usize].decode().unwrap();
            Some(decoded.texels().pixels().to_vec())
        };
        // Materials with the same maps share one.
        assert_eq!(texels(0), texels(1), "{statements}");
        let mut materials = imported.materials.iter();
        let is_blended = materials.all(|m| m.alpha_mode == AlphaMode::Blend);
        (
            texels(0),
            is_blended,
            imported.warnings,
            imported.textures.len(),
        )
    };
    let (texels, is_blended, warnings, count) = load("map_d mask.png\nmap_Kd paint.png\n");
    let alphas = [0, 60, 120, 255, 1, 2, 3, 4];
    let want = |i: usize| match i % 4 < 2 {
        true => [200, 0, 0, alphas[i]],
        false => [0, 100, 0, alphas[i]],
    };
    assert_eq!(texels.unwrap(), (0..8).map(want).collect::<Vec<_>>());
    assert!(
        is_blended && warnings.is_empty() && count == 3,
        "{warnings:?} {count}"
    );
    // In the alpha of a map that has one, and without colours.
    let (texels, ..) = load("map_d leaf.png\nmap_Kd paint.png\n");
    assert_eq!(texels.unwrap(), [[200, 0, 0, 30], [0, 100, 0, 255]]);
    let (texels, ..) = load("map_d leaf.png\nKd 0 1 0\n");
    assert_eq!(texels.unwrap(), [[255, 255, 255, 30], [255; 4]]);
    // What lies elsewhere, what is not there, and what is no image.
    for (statements, warned) in [
        (
            "map_d -s 2 2 mask.png\nmap_Kd paint.png\n",
            "map_d is read only with the options of map_Kd",
        ),
        (
            "map_d gone.png\nmap_Kd paint.png\n",
            "\"gone.png\" cannot be read",
        ),
        ("map_d leaf.tga\nmap_Kd paint.png\n", "map_d is left out: "),
    ] {
        let (texels, is_blended, warnings, _) = load(statements);
        assert_eq!(texels.unwrap(), [[200, 0, 0, 255], [0, 100, 0, 255]]);
        assert!(!is_blended && warnings[0].contains(warned), "{warnings:?}");
    }
}

#[test]
fn a_statement_of_hundreds_of_thousands_of_lines_or_words_is_read_as_a_short_one() {
    let lines = "\\\n".repeat(300_000);
    let mesh = format!("mtllib m.mtl\nv {lines} 0 0 0\nv 1 0 \\\n0\nv 0 1 0\nf 1 2 \\\r\n3\n");
    let words = "xyz ".repeat(300_000);
    let library = format!("newmtl a\nKd {words} 1 1 1\n");
    let project = Project::with(&[("m.obj", mesh.as_bytes()), ("m.mtl", library.as_bytes())]);
    let error = load_object(&project.path("m.obj")).unwrap_err().to_string();
    assert!(
        error.contains("line 2: \"xyz\" is not a finite number"),
        "{error}"
    );
    std::fs::remove_file(project.path("m.mtl")).unwrap();
    assert_eq!(
        project.load("m.obj").mesh.positions,
        [Vec3::ZERO, Vec3::X, Vec3::Y]
    );
}
