//! PLY and STL files.
use dipir_scene::import::{Imported, Limits, load_ply_bytes, load_stl_bytes};
use dipir_scene::material::AlphaMode;
use glam::{Vec3, Vec4};

fn ply(text: &str) -> Result<Imported, String> {
    load_ply_bytes(text.as_bytes(), &Limits::default()).map_err(|e| e.to_string())
}

fn stl(bytes: &[u8]) -> Result<Imported, String> {
    load_stl_bytes(bytes, &Limits::default()).map_err(|e| e.to_string())
}

const SQUARE: &str = "ply\r\nformat ascii 1.0\ncomment made by hand\nelement vertex 4\n\
    property float x\nproperty float y\nproperty double z\nproperty uchar red\n\
    property uchar green\nproperty uchar blue\nelement face 1\nproperty uchar quality\n\
    property list uchar int vertex_indices\nend_header\n\
    0 0 0 255 0 188\n1 0 0 255 0 188\n1 1 0 255 0 188\n0 1 0 255 0 188\n7 4 0 1 2 3\n";

#[test]
fn an_ascii_ply_arrives_with_its_colours() {
    let imported = ply(SQUARE).unwrap();
    assert_eq!(imported.mesh.indices, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(imported.mesh.positions[2], Vec3::new(1.0, 1.0, 0.0));
    // The sRGB value 188 / 255 is ((188 / 255 + 0.055) / 1.055)^2.4 in linear light.
    let blue = ((188.0f32 / 255.0 + 0.055) / 1.055).powf(2.4);
    let expected = Vec4::new(1.0, 0.0, blue, 1.0);
    for color in &imported.mesh.colors {
        assert!((*color - expected).length() < 8.0 * f32::EPSILON);
    }
    assert_eq!(imported.materials[0].base_color, Vec4::ONE);
}

/// A triangle as binary, with normals and a list of another element in between.
fn binary(little: bool) -> Vec<u8> {
    let name = if little { "little" } else { "big" };
    let mut bytes = format!(
        "ply\nformat binary_{name}_endian 1.0\nelement vertex 3\nproperty short x\n\
         property float y\nproperty double z\nproperty float nx\nproperty float ny\n\
         property float nz\nelement edge 2\nproperty list ushort char names\n\
         element face 1\nproperty list uint uint vertex_index\nend_header\n"
    )
    .into_bytes();
    macro_rules! put {
        ($value:expr) => {
            bytes.extend(match little {
                true => $value.to_le_bytes(),
                false => $value.to_be_bytes(),
            })
        };
    }
    for (x, y) in [(0i16, 0.0f32), (256, 0.0), (0, 0.5)] {
        put!(x);
        put!(y);
        put!(-2.0f64);
        for n in [0.0f32, 0.0, 3.0] {
            put!(n);
        }
    }
    for length in [0u16, 2] {
        put!(length);
        (0..length).for_each(|_| bytes.push(9));
    }
    for value in [3u32, 0, 1, 2] {
        put!(value);
    }
    bytes
}

#[test]
fn binary_plys_of_both_byte_orders_mean_the_same() {
    for little in [true, false] {
        let mesh = load_ply_bytes(&binary(little), &Limits::default())
            .unwrap()
            .mesh;
        assert_eq!(mesh.indices, [[0, 1, 2]]);
        let expected = [
            Vec3::new(0.0, 0.0, -2.0),
            Vec3::new(256.0, 0.0, -2.0),
            Vec3::new(0.0, 0.5, -2.0),
        ];
        assert_eq!(mesh.positions, expected);
        assert_eq!(mesh.normals, [Vec3::Z; 3]);
    }
    let whole = binary(true);
    let short = load_ply_bytes(&whole[..whole.len() - 1], &Limits::default());
    assert_eq!(
        short.unwrap_err().to_string(),
        "element face 0: the file ends here; export or copy the file again"
    );
}

#[test]
fn texture_coordinates_of_a_ply_are_left_out_with_a_warning() {
    let with = |properties: &str, values: &str| {
        let vertices = ["0 0 0", "1 0 0", "0 1 0"].map(|v| format!("{v}{values}\n"));
        let text = format!(
            "ply\nformat ascii 1.0\ncomment TextureFile a.png\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\n{properties}element face 1\nproperty list uchar int vertex_indices\nend_header\n{}3 0 1 2\n",
            vertices.concat()
        );
        ply(&text).unwrap().warnings
    };
    assert!(with("", "").is_empty());
    let told = with("property float s\nproperty float t\n", " 0 1");
    assert!(
        told.len() == 1 && told[0].starts_with("texture coordinates and textures are not read"),
        "{told:?}"
    );
}

#[test]
fn a_cloud_of_points_is_refused_with_what_to_do() {
    let cloud = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\n\
        property float z\nend_header\n0 0 0\n1 1 1\n";
    assert_eq!(
        ply(cloud).unwrap_err(),
        "the file is a cloud of 2 points without faces; make a mesh of it, for instance by MeshLab's screened Poisson reconstruction"
    );
}

#[test]
fn broken_plys_say_where() {
    for (from, to, expected) in [
        (
            "7 4 0 1 2 3",
            "7 4 0 1 2 4",
            "element face 0: corner 4, but 4 vertices stand before the faces; export or copy the file again",
        ),
        (
            "1 1 0 255",
            "1 nan 0 255",
            "element vertex 2: the position (1, NaN, 0) is not finite; export or copy the file again",
        ),
        (
            "1 1 0 255",
            "1 one 0 255",
            "element vertex 2: \"one\" is not a number; export or copy the file again",
        ),
        (
            "property double z",
            "property complex z",
            "line 7: \"property complex z\" is not understood; export the file again",
        ),
        (
            "property double z",
            "property double w",
            "element vertex has no x, y and z; export the file again",
        ),
        (
            "element vertex 4",
            "element vertex 90000000",
            "there are 90000000 vertices, of which a triangle has three: more than the limit of 60000000; simplify the object, or raise scene.limits.triangles",
        ),
        (
            "element face 1",
            "element face 18446744073709551615",
            "there are 18446744073709551615 triangles: more than the limit of 20000000; simplify the object, or raise scene.limits.triangles",
        ),
        (
            "7 4 0 1 2 3",
            "7 -1 0 1 2 3",
            "element face 0: a list of -1 numbers; export or copy the file again",
        ),
        (
            "end_header\n",
            "element vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
            "element vertex is there twice; export the file again",
        ),
        (
            "end_header\n",
            "",
            "line 14: \"0 0 0 255 0 188\" is not understood; export the file again",
        ),
    ] {
        let text = SQUARE.replacen(from, to, 1);
        assert_ne!(text, SQUARE);
        // The list's length is unsigned, but a text may say anything.
        assert_eq!(ply(&text).unwrap_err(), expected, "{to}");
    }
}

/// Two triangles of a square, binary.
fn square_stl(header: &[u8]) -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes[..header.len()].copy_from_slice(header);
    bytes.extend(2u32.to_le_bytes());
    for corners in [
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]],
        [[0.0, -0.0], [1.0, 1.0], [0.0, 1.0f32]],
    ] {
        bytes.extend([0; 12]);
        for [x, y] in corners {
            bytes.extend([x, y, 0.5].map(f32::to_le_bytes).as_flattened());
        }
        bytes.extend([0; 2]);
    }
    bytes
}

#[test]
fn binary_and_ascii_stls_share_vertices() {
    let text = "solid square\nfacet normal 0 0 1\n outer loop\n  vertex 0 0 0.5\n  vertex 1 0 0.5\n\
        vertex 1 1 0.5\nendloop\nendfacet\nfacet normal 0 0 1\nouter loop\nvertex 0 0 5e-1\n\
        VERTEX 1 1 0.5\nvertex 0 1 0.5\nendloop\nendfacet\nendsolid\n";
    for bytes in [
        text.as_bytes().to_vec(),
        square_stl(b"made by hand"),
        // Some exporters call a binary file solid.
        square_stl(b"solid binary"),
    ] {
        let imported = stl(&bytes).unwrap();
        assert_eq!(imported.mesh.indices, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(imported.mesh.positions.len(), 4);
        assert_eq!(imported.mesh.scaled_normal(0).z, 1.0);
        // The unit is spoken of where the object is placed.
        assert_eq!(imported.warnings, [""; 0]);
    }
}

#[test]
fn bytes_behind_the_triangles_of_a_binary_stl_are_left_out_with_a_warning() {
    for header in [&b"made by hand"[..], b"solid binary"] {
        let mut bytes = square_stl(header);
        bytes.extend(*b"end");
        let imported = stl(&bytes).unwrap();
        assert_eq!(imported.mesh.indices, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(
            imported.warnings,
            ["the 3 bytes behind the 2 triangles that the file announces are not read"]
        );
    }
    // One that is cut short is not taken for text either.
    assert_eq!(
        stl(&square_stl(b"solid binary")[..150]).unwrap_err(),
        "2 triangles are announced, which take 184 bytes, but the file has 150; export or copy the file again"
    );
}

#[test]
fn an_ascii_stl_may_begin_with_a_byte_order_mark_and_capitals() {
    let facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nendloop\nendfacet\n";
    for start in ["\u{feff}solid a\n", "SOLID a\r\n", " solid \u{e9}\n"] {
        let text = format!("{start}{facet}");
        assert_eq!(stl(text.as_bytes()).unwrap().mesh.indices.len(), 1);
    }
}

#[test]
fn broken_stls_say_where() {
    let whole = square_stl(b"x");
    assert_eq!(
        stl(&whole[..150]).unwrap_err(),
        "2 triangles are announced, which take 184 bytes, but the file has 150; export or copy the file again"
    );
    assert_eq!(
        stl(b"nothing").unwrap_err(),
        "an STL file has 84 bytes or more, this one 7; export or copy the file again"
    );
    assert_eq!(
        stl(b"solid a\nvertex 1 2\n").unwrap_err(),
        "line 2: accepted: vertex x y z; export the file again"
    );
    assert_eq!(
        stl(b"solid a\nvertex 1 2 3\nendfacet\n").unwrap_err(),
        "line 3: a facet of 1 corners; accepted: 3; export the file again"
    );
    assert_eq!(
        stl(b"solid a\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\nvertex 0 0 0\nvertex 1")
            .unwrap_err(),
        "line 7: accepted: vertex x y z; export the file again"
    );
    assert_eq!(
        stl(b"solid a\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\nvertex 0 0 0\n")
            .unwrap_err(),
        "the file ends within a facet; export or copy the file again"
    );
    assert_eq!(
        stl(b"solid a\nendsolid\n").unwrap_err(),
        "the file holds no triangles; check that the file has facets"
    );
    let mut infinite = whole.clone();
    infinite[96..100].copy_from_slice(&f32::INFINITY.to_le_bytes());
    assert_eq!(
        stl(&infinite).unwrap_err(),
        "triangles, element 0 is (inf, 0, 0.5), which is not finite; repair the mesh and export it again"
    );
}

#[test]
fn strips_of_triangles_are_read_and_keep_their_orientation() {
    let vertices = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n0 2 0\n";
    let file = |strips: &str| {
        let count = strips.split(' ').count();
        format!(
            "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n\
             element tristrips 1\nproperty list int int vertex_indices\nend_header\n{vertices}{count} {strips}\n"
        )
    };
    let mesh = ply(&file("0 1 2 3 4 -1 2 3 4 -1 0 1 1 2 3")).unwrap().mesh;
    let [a, b, c]: [[u32; 3]; 3] = [[0, 1, 2], [2, 1, 3], [2, 3, 4]];
    // The last strip says corner 1 twice: two triangles of no area, by which the third is not turned.
    assert_eq!(mesh.indices, [a, b, c, c, [1, 2, 3]]);
    for (t, z) in [1.0, 1.0, 1.0, 1.0, -1.0].into_iter().enumerate() {
        assert_eq!(mesh.scaled_normal(t).z, z);
    }
    assert_eq!(
        ply(&file("0 1 2 -2")).unwrap_err(),
        "element tristrips 0: corner -2, but 5 vertices stand before the faces; export or copy the file again"
    );
}

#[test]
fn the_alpha_of_vertices_is_read_where_it_says_something() {
    let load = |kind: &str, alpha: &str| {
        let text = SQUARE.replacen(
            "element face",
            &format!("property {kind} alpha\nelement face"),
            1,
        );
        ply(&text.replace(" 188\n", &format!(" 188 {alpha}\n"))).unwrap()
    };
    for (kind, alpha, read) in [
        ("uchar", "255", None),
        ("float", "1", None),
        ("uchar", "51", Some(0.2)),
        ("float", "0.25", Some(0.25)),
        ("float", "51", Some(0.2)),
        ("uchar", "0", None),
    ] {
        let imported = load(kind, alpha);
        let expected = read.map_or(AlphaMode::Opaque, |_| AlphaMode::Blend);
        assert_eq!(imported.materials[0].alpha_mode, expected);
        for color in &imported.mesh.colors {
            assert_eq!(
                (color.x, color.w),
                (1.0, read.unwrap_or(1.0)),
                "{kind} {alpha}"
            );
        }
        let told = ["the alpha of all vertices is 0 and not read: the object is opaque"];
        assert_eq!(imported.warnings, told[..usize::from(alpha == "0")]);
    }
    // Without colours grey shows through.
    let colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
    let grey = SQUARE
        .replace(colors, "property float alpha\n")
        .replace(" 255 0 188\n", " 0.5\n");
    let grey = ply(&grey).unwrap();
    assert_eq!(grey.mesh.colors, [Vec4::new(1.0, 1.0, 1.0, 0.5); 4]);
    assert_eq!(grey.materials[0].base_color.x, 0.8);
}

#[test]
fn colours_of_a_binary_stl_are_read_as_viscam_and_magics_write_them() {
    let plain = square_stl(b"made by hand");
    let colored = |header: &[u8], bits: [u16; 2]| {
        let mut bytes = square_stl(header);
        bytes[132..134].copy_from_slice(&bits[0].to_le_bytes());
        bytes[182..184].copy_from_slice(&bits[1].to_le_bytes());
        let imported = stl(&bytes).unwrap();
        assert_eq!(imported.warnings, [""; 0]);
        assert_eq!(imported.materials[0].base_color, Vec4::ONE);
        let mesh = &imported.mesh;
        let of = |t: usize| {
            let colors = mesh.indices[t].map(|i| mesh.colors[i as usize]);
            assert!(colors.iter().all(|c| *c == colors[0]));
            colors[0]
        };
        [of(0), of(1)]
    };
    assert!(stl(&plain).unwrap().mesh.colors.is_empty());
    let [red, blue] = [Vec4::new(1.0, 0.0, 0.0, 1.0), Vec4::new(0.0, 0.0, 1.0, 1.0)];
    let grey = Vec4::new(0.8, 0.8, 0.8, 1.0);
    // VisCAM: blue in the lowest bits, the highest says that there is a colour.
    assert_eq!(colored(b"made by hand", [0xfc00, 0x7c00]), [red, grey]);
    assert_eq!(colored(b"made by hand", [0x801f, 0xfc00]), [blue, red]);
    // Magics: red in the lowest bits, the highest says that the colour is that of the whole.
    let whole = b"by hand COLOR=\x00\x00\xff\xff";
    assert_eq!(colored(whole, [0x001f, 0x8000]), [red, blue]);
    assert_eq!(
        colored(whole, [0, 0x001f])[0],
        Vec4::new(0.0, 0.0, 0.0, 1.0)
    );
    assert_eq!(colored(whole, [0, 0]), [blue, blue]);
}

#[test]
fn gaussian_splats_are_told_from_other_points() {
    let text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
        property float f_dc_0\nend_header\n0 0 0 1\n";
    assert_eq!(
        ply(text).unwrap_err(),
        "the file holds 1 Gaussian splats, not a mesh; export a mesh (.glb or .obj) from the program that made it"
    );
}

#[test]
fn triangles_that_a_binary_stl_does_not_announce_are_read() {
    let mut bytes = square_stl(b"streamed");
    bytes[80..84].fill(0);
    let imported = stl(&bytes).unwrap();
    assert_eq!(imported.mesh.indices, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(
        imported.warnings,
        ["no triangles are announced, and the 2 for which the file has bytes are read"]
    );
    // Not whole ones.
    bytes.pop();
    assert!(
        stl(&bytes)
            .unwrap_err()
            .starts_with("the file holds no triangles")
    );
}

#[test]
fn lines_of_an_stl_may_end_with_a_carriage_return_alone() {
    let text = "solid a\rfacet normal 0 0 1\router loop\rvertex 0 0 0\rvertex 1 0 0\rvertex 1 1 0\rendloop\rendfacet\r";
    assert_eq!(stl(text.as_bytes()).unwrap().mesh.indices.len(), 1);
}
