//! OBJ and MTL files.
use dipir_scene::import::{Imported, Limits, NoFiles, load_obj_bytes, load_object};
use dipir_scene::material::AlphaMode;
use glam::{Vec2, Vec3, Vec4};

use crate::glb::one_texel_png;

fn load(text: &str) -> Imported {
    load_obj_bytes(text.as_bytes(), &NoFiles, &Limits::default()).unwrap()
}

fn message(text: &str) -> String {
    load_obj_bytes(text.as_bytes(), &NoFiles, &Limits::default())
        .unwrap_err()
        .to_string()
}

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

#[test]
fn polygons_become_fans_and_negative_indices_count_from_the_end() {
    for face in ["f 1 2 3 4", "f -4 -3 -2 -1", "f 1 2 \\\n 3 4"] {
        let imported = load(&format!("{SQUARE}{face}\n"));
        assert_eq!(imported.mesh.indices, [[0, 1, 2], [0, 2, 3]], "{face}");
        assert!(imported.mesh.normals.is_empty());
        assert!(imported.materials[0].double_sided);
    }
}

/// With work that grows with the square of the corners this would take hours.
#[test]
fn a_face_of_more_than_a_million_corners_becomes_a_fan_that_rays_meet() {
    const CORNERS: u32 = 1_200_000;
    let mut text = String::new();
    for k in 0..CORNERS {
        let angle = std::f32::consts::TAU * k as f32 / CORNERS as f32;
        text += &format!("v {} {} 0\n", angle.cos(), angle.sin());
    }
    text += "f";
    for k in 1..=CORNERS {
        text += &format!(" {k}");
    }
    let mesh = load(&(text + "\n")).mesh;
    assert_eq!(mesh.indices.len() as u32, CORNERS - 2);
    let bvh = dipir_scene::bvh::Bvh::build(&mesh);
    let ray = dipir_scene::camera::Ray {
        origin: Vec3::new(0.1, -0.2, 1.0),
        direction: Vec3::NEG_Z,
    };
    assert!(bvh.closest(&ray, f32::INFINITY, |_, _, _| true).is_some());
}

#[test]
fn hostile_indices_are_refused_with_their_line() {
    for (face, number, things) in [
        ("f 1 2 5", "5", "4 vertices (v)"),
        ("f 0 1 2", "0", "4 vertices (v)"),
        ("f -5 1 2", "-5", "4 vertices (v)"),
        (
            "f 1 2 9223372036854775807",
            "9223372036854775807",
            "4 vertices (v)",
        ),
        (
            "f -9223372036854775808 1 2",
            "-9223372036854775808",
            "4 vertices (v)",
        ),
        ("f 1/1 2 3", "1", "0 texture coordinates (vt)"),
        ("f 1//7 2 3", "7", "0 normals (vn)"),
    ] {
        assert_eq!(
            message(&format!("{SQUARE}{face}\n")),
            format!(
                "line 5: a face refers to {number}, but there are {things} so far; export the file again"
            )
        );
    }
}

#[test]
fn malformed_lines_are_named() {
    assert_eq!(
        message("v 0 zero 0\n"),
        "line 1: \"zero\" is not a number; accepted: v x y z; export the file again"
    );
    assert_eq!(
        message(&format!("{SQUARE}f 1 2\n")),
        "the file holds no triangles; check that the file has faces (f)"
    );
    assert_eq!(
        message("v 0 nan 0\n"),
        "vertices (v), element 1 is (0, NaN, 0), which is not finite; repair the mesh and export it again"
    );
    assert_eq!(
        message("# nothing\n"),
        "the file holds no triangles; check that the file has faces (f)"
    );
}

#[test]
fn a_missing_material_library_is_a_warning() {
    let imported = load(&format!("mtllib gone.mtl\n{SQUARE}usemtl red\nf 1 2 3\n"));
    assert_eq!(
        imported.warnings,
        [
            "material library \"gone.mtl\" cannot be read (no other files are read here); grey is used",
            "material \"red\" is not defined; grey is used",
        ]
    );
    assert_eq!(
        imported.materials[0].base_color,
        Vec4::new(0.8, 0.8, 0.8, 1.0)
    );
}

#[test]
fn material_statements_become_metallic_roughness() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("my paint.png"), one_texel_png([1.0, 0.0, 0.0])).unwrap();
    std::fs::write(
        file("m.mtl"),
        "newmtl phong\nKd 0.1 0.2 0.3\nKs 0.5 0.5 0.5\nNs 30\nd 0.5\n\
         newmtl pbr\nPm 0.9\nPr 0.2\nKe 1 2 3\nmap_Kd -s 2 4 1 my paint.png\nnorm my paint.png\n\
         newmtl dull\nKs 0 0 0\n",
    )
    .unwrap();
    std::fs::write(
        file("m.obj"),
        format!(
            "mtllib m.mtl\n{SQUARE}vt 0 0\nvt 1 0.25\nusemtl phong\nf 1 2 3\nusemtl pbr\nf 1/1 3/2 4/1\n"
        ),
    )
    .unwrap();
    let imported = load_object(&file("m.obj")).unwrap();
    let [phong, pbr, dull] = &imported.materials[..] else {
        panic!("three materials");
    };
    assert_eq!(phong.base_color, Vec4::new(0.1, 0.2, 0.3, 0.5));
    assert_eq!(phong.alpha_mode, AlphaMode::Blend);
    // alpha^2 = 2 / 32, and roughness is the root of alpha.
    assert!((phong.roughness - 0.5).abs() < f32::EPSILON);
    assert_eq!((phong.metallic, phong.ior), (0.0, 1.5));
    assert_eq!((pbr.metallic, pbr.roughness), (0.9, 0.2));
    assert_eq!(pbr.emissive, Vec3::new(1.0, 2.0, 3.0));
    assert_eq!(dull.ior, 1.0);
    let paint = pbr.base_color_texture.unwrap();
    // s = 2, 4 on a v that points up: 1 - 4 (1 - v).
    assert_eq!(paint.apply(Vec2::new(0.5, 1.0)), Vec2::new(1.0, 1.0));
    assert_eq!(paint.apply(Vec2::new(0.5, 0.75)), Vec2::new(1.0, 0.0));
    assert_eq!(imported.mesh.materials, [0, 1]);
    assert!(imported.mesh.uvs[0].contains(&Vec2::new(1.0, 0.75)));
    assert_eq!(imported.mesh.tangents.len(), imported.mesh.positions.len());
    assert_eq!(imported.dependencies, [file("m.mtl"), file("my paint.png")]);
}

#[test]
fn a_library_named_for_every_group_is_read_once() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("m.mtl"), "newmtl a\n").unwrap();
    let path = folder.path().join("m.obj");
    let group = "mtllib m.mtl\nusemtl a\nf 1 2 3\n";
    std::fs::write(&path, format!("{SQUARE}{group}{group}")).unwrap();
    let imported = load_object(&path).unwrap();
    assert_eq!(imported.materials.len(), 1);
    assert_eq!(imported.mesh.materials, [0, 0]);
}

#[test]
fn one_statement_may_name_several_libraries() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("a.mtl"), "newmtl a\nPm 0.25\n").unwrap();
    std::fs::write(file("b.mtl"), "newmtl b\nPm 0.5\n").unwrap();
    let text = format!("mtllib a.mtl b.mtl gone.mtl\n{SQUARE}usemtl b\nf 1 2 3\n");
    std::fs::write(file("m.obj"), text).unwrap();
    let imported = load_object(&file("m.obj")).unwrap();
    let metal: Vec<f32> = imported.materials.iter().map(|m| m.metallic).collect();
    assert_eq!(
        (metal, &imported.mesh.materials[..]),
        (vec![0.25, 0.5], &[1][..])
    );
    assert!(imported.warnings.len() == 1 && imported.warnings[0].contains("\"gone.mtl\""));
    // A name may have blanks.
    std::fs::rename(file("b.mtl"), file("a.mtl b.mtl")).unwrap();
    let text = format!("mtllib a.mtl b.mtl\n{SQUARE}usemtl b\nf 1 2 3\n");
    std::fs::write(file("m.obj"), text).unwrap();
    assert_eq!(load_object(&file("m.obj")).unwrap().materials.len(), 1);
}

#[test]
fn a_texture_that_a_library_names_and_is_missing_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let statements = "newmtl a\nKd 0.5 0.25 0.125\nNs 30\nmap_Kd gone.png\nmap_Pr rough.png\n\
                      bump bumps.png\nmap_Ke glow.png\nKe 1 1 1\n";
    std::fs::write(folder.path().join("m.mtl"), statements).unwrap();
    let path = folder.path().join("m.obj");
    std::fs::write(&path, format!("mtllib m.mtl\nusemtl a\n{SQUARE}f 1 2 3\n")).unwrap();
    let imported = load_object(&path).unwrap();
    let without = |name: &str| {
        format!(
            "the texture \"{name}\" cannot be read (No such file or directory); the material's factors alone are used"
        )
    };
    assert_eq!(
        imported.warnings,
        [
            without("gone.png"),
            without("rough.png"),
            without("bumps.png"),
            without("glow.png"),
            "material \"a\": without map_Ke it does not emit light".into(),
        ]
    );
    let material = &imported.materials[0];
    assert_eq!(material.base_color, Vec4::new(0.5, 0.25, 0.125, 1.0));
    assert_eq!(material.roughness, (2.0f32 / 32.0).powf(0.25));
    assert_eq!(material.emissive, Vec3::ZERO);
    assert!(imported.textures.is_empty());
}

#[test]
fn a_texture_named_by_its_place_on_another_machine_is_found_beside_the_object() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("my paint.png"), one_texel_png([1.0, 0.0, 0.0])).unwrap();
    std::fs::write(
        file("m.obj"),
        format!("mtllib \"m.mtl\"\nusemtl a\n{SQUARE}f 1 2 3\n"),
    )
    .unwrap();
    for named in [
        r"C:\Users\me\my paint.png",
        "/home/me/my paint.png",
        "../maps/my paint.png",
        "maps/my paint.png",
        "\"my paint.png\"",
    ] {
        std::fs::write(file("m.mtl"), format!("newmtl a\nmap_Kd {named}\n")).unwrap();
        let imported = load_object(&file("m.obj")).unwrap();
        assert_eq!(
            imported.dependencies,
            [file("m.mtl"), file("my paint.png")],
            "{named}"
        );
    }
    // One that lies where it is named goes before.
    std::fs::create_dir(file("maps")).unwrap();
    std::fs::copy(file("my paint.png"), file("maps/my paint.png")).unwrap();
    std::fs::write(file("m.mtl"), "newmtl a\nmap_Kd maps/my paint.png\n").unwrap();
    let imported = load_object(&file("m.obj")).unwrap();
    assert_eq!(imported.dependencies[1], file("maps/my paint.png"));
}

#[test]
fn vertex_colours_in_bytes_mean_the_same() {
    let colors = |a: &str, b: &str| {
        let text = format!("v 0 0 0 {a}\nv 1 0 0 {b}\nv 0 1 0\nf 1 2 3\n");
        load(&text).mesh.colors
    };
    let units = colors("1 0.2 0", "0 0 0");
    assert_eq!(colors("255 51 0", "0 0 0"), units);
    assert_eq!(units[2], Vec4::ONE);
    // A number that is none does not decide it.
    assert_eq!(colors("1 0.2 0", "inf 0 0")[0], units[0]);
}

#[test]
fn lines_that_end_with_a_carriage_return_alone_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let read = |end: &str| {
        let write = |name: &str, text: &str| {
            std::fs::write(folder.path().join(name), text.replace('\n', end)).unwrap();
        };
        write(
            "a.obj",
            &format!("mtllib a.mtl\nusemtl red\n{SQUARE}f 1 2 3 4\n"),
        );
        write("a.mtl", "newmtl red\nKd 1 0 0\n");
        load_object(&folder.path().join("a.obj")).unwrap()
    };
    let (unix, old) = (read("\n"), read("\r"));
    assert_eq!(old.mesh.positions, unix.mesh.positions);
    assert_eq!(old.materials, unix.materials);
    assert_eq!(old.materials[0].name, "red");
}

#[test]
fn free_form_surfaces_are_left_out_with_a_warning() {
    let text = format!("{SQUARE}f 1 2 3\ncstype bspline\nsurf 0 1 0 1 1 2 3 4\nend\n");
    let told = load(&text).warnings;
    assert!(
        told.len() == 1 && told[0].starts_with("curves and free-form surfaces are not drawn"),
        "{told:?}"
    );
}

#[test]
fn statements_without_an_effect_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let mesh = format!("mtllib m.mtl\nusemtl a\n{SQUARE}f 1 2 3\n");
    std::fs::write(file("m.obj"), mesh).unwrap();
    let load = |statements: &str| {
        std::fs::write(file("m.mtl"), format!("newmtl a\n{statements}")).unwrap();
        load_object(&file("m.obj")).unwrap()
    };
    let left_out = load("Ps 0.5\naniso 0\nmap_Ks x.png\nmap_Kd\n");
    assert_eq!(
        left_out.warnings,
        [
            "material \"a\": map_Kd names no file",
            "material \"a\": Ps, map_Ks not supported and left out",
        ]
    );
    let coat = load("Pc 0.75\nPcr 0.25\n").materials[0].clearcoat.unwrap();
    assert_eq!((coat.factor, coat.roughness), (0.75, 0.25));
    assert!(
        load("Pc 0\nPcr 0.03\nPs 0\n").materials[0]
            .clearcoat
            .is_none()
    );
}

#[test]
fn a_grey_bump_map_is_one_of_heights_and_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    let mesh = format!("mtllib m.mtl\nusemtl a\n{SQUARE}f 1 2 3\n");
    std::fs::write(file("m.obj"), mesh).unwrap();
    std::fs::write(file("m.mtl"), "newmtl a\nmap_Bump -bm 0.5 bumps.png\n").unwrap();
    let normal_map = |color: [f32; 3]| {
        std::fs::write(file("bumps.png"), one_texel_png(color)).unwrap();
        let imported = load_object(&file("m.obj")).unwrap();
        let about = |w: &&String| w.contains("map_Bump");
        let told: Vec<&String> = imported.warnings.iter().filter(about).collect();
        let found = imported.materials[0].normal_texture;
        assert!(told.len() == 1, "{told:?}");
        assert_eq!(told[0].contains("a map of heights"), found.is_none());
        found.map(|(_, scale)| scale)
    };
    assert_eq!(normal_map([0.5, 0.5, 1.0]), Some(0.5));
    assert_eq!(normal_map([0.5, 0.5, 0.5]), None);
}

#[test]
fn normals_and_display_referred_vertex_colours_arrive() {
    let imported =
        load("v 0 0 0 1 0.5 0\nv 1 0 0 1 0.5 0\nv 0 1 0 1 0.5 0\nvn 0 0 2\nf 1//1 2//1 3//1\n");
    assert_eq!(imported.mesh.normals, [Vec3::Z; 3]);
    // sRGB 0.5 is ((0.5 + 0.055) / 1.055)^2.4 in linear light.
    let linear = (0.555f32 / 1.055).powf(2.4);
    assert!((imported.mesh.colors[0].y - linear).abs() < 4.0 * f32::EPSILON);
    // They are the surface's own, which without a material nothing darkens.
    assert_eq!(imported.materials[0].base_color, Vec4::ONE);
    let plain = load(&format!("{SQUARE}f 1 2 3\n"));
    assert!(plain.materials[0].base_color.x < 1.0);
}

#[test]
fn a_grey_map_of_roughness_does_not_dim_metal() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    for name in ["rough.png", "both.png"] {
        std::fs::write(file(name), one_texel_png([0.2; 3])).unwrap();
    }
    std::fs::write(
        file("m.obj"),
        format!("mtllib m.mtl\nusemtl a\n{SQUARE}f 1 2 3\n"),
    )
    .unwrap();
    for (maps, is_textured, warnings) in [
        ("map_Pr rough.png", false, 0),
        ("map_Pr rough.png\nmap_Pm metal.png", false, 1),
        ("map_Pr both.png\nmap_Pm both.png", true, 0),
    ] {
        std::fs::write(file("m.mtl"), format!("newmtl a\nPm 1\nPr 1\n{maps}\n")).unwrap();
        let imported = load_object(&file("m.obj")).unwrap();
        let material = &imported.materials[0];
        assert!(material.metallic_roughness_texture.is_some(), "{maps}");
        assert_eq!(material.metallic_is_textured, is_textured, "{maps}");
        let told = imported.warnings.iter().filter(|w| w.contains("metalness"));
        assert_eq!(told.count(), warnings, "{maps}");
    }
}

#[test]
fn comments_foreign_letters_and_blanks_do_no_harm() {
    let imported = load("v 0 0 0 # corner\nv\t1 0 0\r\nv 1 1 0\nf 1 2 3 # face\n");
    assert_eq!(imported.mesh.indices, [[0, 1, 2]]);
    // Latin-1, as old exporters write it.
    let latin = [
        b"# caf\xe9\nusemtl caf\xe9\n",
        format!("{SQUARE}f 1 2 3\n").as_bytes(),
    ]
    .concat();
    let imported = load_obj_bytes(&latin, &NoFiles, &Limits::default()).unwrap();
    assert_eq!(imported.mesh.indices, [[0, 1, 2]]);
}

#[test]
fn a_byte_order_mark_hides_neither_the_first_line_nor_the_first_material() {
    const MARK: &str = "\u{feff}";
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let object = format!("{MARK}mtllib a.mtl\r\n{SQUARE}usemtl red\r\nf 1 2 3\r\n");
    std::fs::write(at("a.obj"), object).unwrap();
    std::fs::write(at("a.mtl"), format!("{MARK}newmtl red\r\nKd 1 0 0\r\n")).unwrap();
    let imported = load_object(&at("a.obj")).unwrap();
    assert!(imported.warnings.is_empty(), "{:?}", imported.warnings);
    assert_eq!(
        imported.materials[0].base_color,
        Vec4::new(1.0, 0.0, 0.0, 1.0)
    );
}

#[test]
fn corners_without_coordinates_take_none_from_others() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("p.png"), one_texel_png([1.0; 3])).unwrap();
    std::fs::write(folder.path().join("m.mtl"), "newmtl a\nmap_Kd p.png\n").unwrap();
    let path = folder.path().join("m.obj");
    std::fs::write(
        &path,
        format!("mtllib m.mtl\nusemtl a\n{SQUARE}vt 0.25 1\nvt 0.5 1\nf 1/1 2 3/2\n"),
    )
    .unwrap();
    let imported = load_object(&path).unwrap();
    assert_eq!(
        imported.mesh.uvs[0],
        [Vec2::new(0.25, 0.0), Vec2::ZERO, Vec2::new(0.5, 0.0)]
    );
}

#[test]
fn vertices_without_colour_are_white_and_weights_are_passed_over() {
    let imported = load("v 0 0 0\nv 2 0 0 1\nv 0 1 0 0 0 0\nv 0 2 0 1 0 0 0\nf 1 2 3 4\n");
    assert_eq!(imported.mesh.positions[1], Vec3::new(2.0, 0.0, 0.0));
    let [black, red] = [0.0, 1.0].map(|r| Vec4::new(r, 0.0, 0.0, 1.0));
    assert_eq!(imported.mesh.colors, [Vec4::ONE, Vec4::ONE, black, red]);
}

#[test]
fn one_number_is_a_grey_and_alpha_may_have_a_halo() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("m.mtl"), "newmtl a\nKd 0.5 # grey\nd -halo 0.25\n").unwrap();
    std::fs::write(
        file("m.obj"),
        format!("mtllib m.mtl\nusemtl a\n{SQUARE}f 1 2 3\n"),
    )
    .unwrap();
    let imported = load_object(&file("m.obj")).unwrap();
    assert_eq!(
        imported.materials[0].base_color,
        Vec4::new(0.5, 0.5, 0.5, 0.25)
    );
    std::fs::write(file("m.mtl"), "newmtl a\n\nKd 0.5 blue 0\n").unwrap();
    assert_eq!(
        load_object(&file("m.obj")).unwrap_err().to_string(),
        format!(
            "\"{}\": \"m.mtl\": line 3: \"blue\" is not a finite number; export the material library again",
            file("m.obj").display()
        )
    );
}

#[test]
fn a_mark_within_a_name_belongs_to_it_and_a_comment_behind_one_does_not() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("wood#2.png"), one_texel_png([1.0; 3])).unwrap();
    std::fs::write(
        file("m.mtl"),
        "newmtl Material #1\nPm 0.1\nnewmtl Material #2 \nPm 0.2 # metal\n\
         newmtl red # paint\nPm 0.3\nmap_Kd wood#2.png # of oak\n",
    )
    .unwrap();
    std::fs::write(
        file("m.obj"),
        format!(
            "mtllib m.mtl # beside\n{SQUARE}vt 0 0\nusemtl Material #2\nf 1/1 2/1 3/1\nusemtl Material #1\nf 1/1 2/1 4/1\n\
             usemtl red\nf 1/1 3/1 4/1\nusemtl red # again\nf 2/1 3/1 4/1 # last\n"
        ),
    )
    .unwrap();
    let imported = load_object(&file("m.obj")).unwrap();
    assert_eq!(imported.warnings, [""; 0]);
    let metal = |m: &u32| imported.materials[*m as usize].metallic;
    let all: Vec<f32> = imported.mesh.materials.iter().map(metal).collect();
    assert_eq!(all, [0.2, 0.1, 0.3, 0.3]);
    assert_eq!(imported.dependencies, [file("m.mtl"), file("wood#2.png")]);
}

#[test]
fn a_comment_ends_with_its_line() {
    let folder = "# from C:\\models\\\n";
    let imported = load(&format!("{folder}{SQUARE}f 1 2 \\\n3\n"));
    assert_eq!(imported.mesh.indices, [[0, 1, 2]]);
    assert_eq!(imported.mesh.positions[1], Vec3::X);
}

#[test]
fn tangents_go_along_the_normal_map_as_its_options_turn_it() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("n.png"), one_texel_png([0.5, 0.5, 1.0])).unwrap();
    std::fs::write(
        file("m.obj"),
        format!("mtllib m.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nusemtl a\nf 1/1 2/2 3/3\n"),
    )
    .unwrap();
    // Mirrored, the map's u grows along -x, and its v as before.
    for (option, want) in [
        ("", Vec3::X.extend(1.0)),
        ("-s -1 1 1 ", Vec3::NEG_X.extend(-1.0)),
    ] {
        let library = format!("newmtl a\nnorm {option}n.png\n");
        std::fs::write(file("m.mtl"), library).unwrap();
        let imported = load_object(&file("m.obj")).unwrap();
        assert_eq!(imported.mesh.tangents, [want; 3], "{option}");
    }
}

#[test]
fn materials_whose_normal_maps_are_mirrored_differently_share_no_tangents() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(file("n.png"), one_texel_png([0.5, 0.5, 1.0])).unwrap();
    // Two triangles of a square, which share two vertices.
    std::fs::write(
        file("m.obj"),
        format!(
            "mtllib m.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\nusemtl b\nf 1/1 3/3 4/4\n"
        ),
    )
    .unwrap();
    let tangents = |options: [&str; 2]| {
        let [a, b] = options.map(|option| format!("norm {option}n.png\n"));
        std::fs::write(file("m.mtl"), format!("newmtl a\n{a}newmtl b\n{b}")).unwrap();
        let mesh = load_object(&file("m.obj")).unwrap().mesh;
        let of = |t: &[u32; 3]| t.map(|i| mesh.tangents[i as usize]);
        mesh.indices.iter().map(of).collect::<Vec<_>>()
    };
    let plain = Vec3::X.extend(1.0);
    // Mirrored in u, its u runs the other way; in v, it does not; in both, it is turned by half a turn.
    for (option, want) in [
        ("", plain),
        ("-s 2 3 1 ", plain),
        ("-s -1 1 1 ", Vec3::NEG_X.extend(-1.0)),
        ("-s 1 -1 1 ", Vec3::X.extend(-1.0)),
        ("-s -1 -1 1 ", Vec3::NEG_X.extend(1.0)),
    ] {
        assert_eq!(tangents(["", option]), [[plain; 3], [want; 3]], "{option}");
        assert_eq!(tangents([option, ""]), [[want; 3], [plain; 3]], "{option}");
    }
}

#[test]
fn opacity_wins_over_what_some_exporters_write_as_transparency() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name);
    std::fs::write(
        file("m.obj"),
        format!("mtllib m.mtl\n{SQUARE}usemtl a\nf 1 2 3\n"),
    )
    .unwrap();
    for (statements, want) in [
        ("d 1\nTr 1\n", 1.0),
        ("Tr 1\nd 1\n", 1.0),
        ("Tr 0.25\n", 0.75),
    ] {
        std::fs::write(file("m.mtl"), format!("newmtl a\n{statements}")).unwrap();
        let imported = load_object(&file("m.obj")).unwrap();
        assert_eq!(imported.materials[0].base_color.w, want, "{statements}");
    }
}
