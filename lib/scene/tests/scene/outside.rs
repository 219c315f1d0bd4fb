//! Files that a document names by paths that climb out of its folder, or by links.
use std::path::Path;

use dipir_scene::import::{Imported, Limits, load_object, load_object_within};
use dipir_scene::texture::ImageSource;
use serde_json::json;

use crate::glb::{Glb, TRIANGLE, one_texel_png};

const OUTSIDE: &str = ": it lies outside of the object's folder; copy it into that, or set scene.limits.allow_outside = true";

#[test]
fn buffers_outside_of_the_objects_folder_are_read_by_relative_paths_and_other_files_refused_unless_allowed()
 {
    let folder = tempfile::tempdir().unwrap();
    let inside = folder.path().join("models");
    std::fs::create_dir(&inside).unwrap();
    let outside = folder.path().join("t.bin");
    std::fs::write(&outside, TRIANGLE.map(f32::to_le_bytes).as_flattened()).unwrap();
    std::fs::copy(&outside, inside.join("t.bin")).unwrap();
    std::fs::copy(&outside, folder.path().join("secret")).unwrap();
    let path = inside.join("t.gltf");
    let load = |uri: &str, allow_outside: bool| {
        let mut glb = Glb::triangle(json!({}));
        glb.json["buffers"] = json!([{ "uri": uri, "byteLength": 36 }]);
        std::fs::write(&path, glb.json.to_string()).unwrap();
        let limits = Limits {
            allow_outside,
            ..Limits::default()
        };
        load_object_within(&path, &limits).map_err(|e| e.to_string())
    };
    let absolute = outside.to_str().unwrap();
    for uri in ["../t.bin", "%2e%2e/t.bin", "..\\t.bin", "../models/t.bin"] {
        let found = load(uri, false).unwrap().dependencies;
        assert!(found.len() == 1 && found[0].exists(), "{uri}: {found:?}");
    }
    for uri in ["../secret", "../models/../secret", absolute] {
        let error = load(uri, false).unwrap_err();
        assert!(error.ends_with(OUTSIDE), "{uri}: {error}");
        assert!(load(uri, true).is_ok());
    }
    assert!(load("../gone.bin", false).is_err());
    assert!(load("./x/../t.bin", false).is_err(), "x does not exist");
    assert!(load("./t.bin", false).is_ok());
}

/// An OBJ and a glTF file in `models` whose texture is `uri`.
fn textured(folder: &Path, uri: &str) -> [Imported; 2] {
    let write = |name: &str, text: &str| std::fs::write(folder.join(name), text).unwrap();
    write("models/m.mtl", &format!("newmtl a\nmap_Kd {uri}\n"));
    let face = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n";
    write("models/m.obj", &format!("mtllib m.mtl\n{face}"));
    let mut glb = Glb::triangle(json!({ "material": 0 }));
    glb.push("images", json!({ "uri": uri }));
    glb.push("textures", json!({ "source": 0 }));
    let base = json!({ "baseColorTexture": { "index": 0 } });
    glb.push("materials", json!({ "pbrMetallicRoughness": base }));
    std::fs::write(folder.join("models/m.glb"), glb.bytes()).unwrap();
    ["m.obj", "m.glb"].map(|name| load_object(&folder.join("models").join(name)).unwrap())
}

#[test]
fn a_texture_outside_of_the_objects_folder_is_read_by_a_relative_path_if_it_is_an_image() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for made in ["models", "textures"] {
        std::fs::create_dir(folder.join(made)).unwrap();
    }
    let at = |name: &str| folder.join("models").join(name);
    std::fs::write(folder.join("textures/x.png"), one_texel_png([1.0; 3])).unwrap();
    std::fs::write(folder.join("textures/secret"), "root:x:0:0").unwrap();
    for imported in textured(folder, "../textures/x.png") {
        let texture = &imported.textures[0];
        assert!(
            matches!(&texture.image, ImageSource::File(found) if *found == at("../textures/x.png"))
        );
        assert!(texture.decode().is_ok());
        assert_eq!(imported.dependencies.last(), Some(&at("../textures/x.png")));
        assert!(imported.missing.is_empty());
        assert!(
            !imported
                .warnings
                .iter()
                .any(|w| w.contains("cannot be read"))
        );
    }
    // Its letters may be of another case.
    for imported in textured(folder, "../Textures/X.png") {
        assert_eq!(imported.textures.len(), 1, "{:?}", imported.warnings);
    }
    for imported in textured(folder, "../textures/gone.png") {
        assert!(imported.textures.is_empty());
        assert!(imported.missing.contains(&at("../textures/gone.png")));
        assert!(imported.warnings[0].contains("cannot be read (No such file"));
    }
    for imported in textured(folder, "../textures/secret") {
        assert!(imported.textures.is_empty());
        let all = imported.dependencies.iter().chain(&imported.missing);
        assert!(
            all.into_iter()
                .all(|path| !path.ends_with("textures/secret"))
        );
        let told =
            "is no PNG, JPEG, WebP, BMP or Targa image); the material's factors alone are used";
        assert!(imported.warnings[0].ends_with(told));
    }
    // What lies beside the object is used where the path leads nowhere.
    std::fs::write(at("gone.png"), one_texel_png([1.0; 3])).unwrap();
    for imported in textured(folder, "../textures/gone.png") {
        assert_eq!(imported.dependencies.last(), Some(&at("gone.png")));
    }
}

#[cfg(unix)]
#[test]
fn a_pipe_and_a_large_file_outside_of_the_objects_folder_are_refused() {
    use rustix::fs::{CWD, FileType, Mode, mknodat};
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    std::fs::create_dir(folder.join("models")).unwrap();
    std::fs::write(folder.join("x.png"), one_texel_png([1.0; 3])).unwrap();
    mknodat(CWD, folder.join("pipe.png"), FileType::Fifo, Mode::RUSR, 0).unwrap();
    textured(folder, "../x.png");
    let path = folder.join("models/m.obj");
    let limits = Limits {
        file_bytes: 68,
        ..Limits::default()
    };
    std::fs::write(&path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nmtllib m.mtl\nf 1 2 3\n").unwrap();
    let error = load_object_within(&path, &limits).unwrap_err().to_string();
    assert!(error.contains("scene.limits.file_bytes"), "{error}");
    std::fs::write(
        folder.join("models/m.mtl"),
        "newmtl a\nmap_Kd ../pipe.png\n",
    )
    .unwrap();
    let error = load_object(&path).unwrap_err().to_string();
    assert!(error.ends_with("not a regular file"), "{error}");
}

#[cfg(unix)]
#[test]
fn links_that_lead_out_of_the_objects_folder_are_refused_unless_allowed() {
    use std::os::unix::fs::symlink;
    let folder = tempfile::tempdir().unwrap();
    let inside = folder.path().join("models");
    let outside = folder.path().join("other");
    for made in [&inside, &outside] {
        std::fs::create_dir(made).unwrap();
        let bytes = TRIANGLE.map(f32::to_le_bytes);
        std::fs::write(made.join("t.bin"), bytes.as_flattened()).unwrap();
    }
    symlink(outside.join("t.bin"), inside.join("out.bin")).unwrap();
    symlink("t.bin", inside.join("in.bin")).unwrap();
    symlink("../other", inside.join("textures")).unwrap();
    symlink(&inside, folder.path().join("way")).unwrap();
    let load = |through: &str, uri: &str, allow_outside: bool| {
        let mut glb = Glb::triangle(json!({}));
        glb.json["buffers"] = json!([{ "uri": uri, "byteLength": 36 }]);
        let path = folder.path().join(through).join("t.gltf");
        std::fs::write(&path, glb.json.to_string()).unwrap();
        let limits = Limits {
            allow_outside,
            ..Limits::default()
        };
        load_object_within(&path, &limits).map_err(|e| e.to_string())
    };
    for through in ["models", "way"] {
        for uri in ["out.bin", "textures/t.bin"] {
            let error = load(through, uri, false).unwrap_err();
            assert!(
                error.ends_with(
                    ": it lies outside of the object's folder; copy it into that, or set scene.limits.allow_outside = true"
                ),
                "{uri}: {error}"
            );
            assert!(load(through, uri, true).is_ok());
        }
        assert!(load(through, "in.bin", false).is_ok());
    }
}
