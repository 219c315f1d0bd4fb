//! What users get wrong, and the exact words that tell them.
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;

use crate::project::*;

#[track_caller]
fn scene_fails(project: &Project, set: &str, code: i32, message: &str) {
    project
        .run(SCENE, &["--set", set])
        .expect_error(code, message);
    assert!(!project.path("out/scene").exists(), "nothing was written");
}

#[test]
fn a_misspelt_key_is_named_with_its_line() {
    let project = Project::new();
    project.write(
        "pipeline.toml",
        "[scene]\nbackgruond = \"background.png\"\n",
    );
    project.run(SCENE, &[]).expect_error(
        2,
        "error: pipeline.toml:2: unknown key \"scene.backgruond\" (did you mean \"background\"?); \
         [scene] accepts: background, transfer, class, occluders, depth, depth_kind, depth_scale, \
         depth_surfaces, objects, camera, proxy, views, effects, limits",
    );
}

#[test]
fn a_wrong_type_is_told_with_the_accepted_one() {
    let project = Project::new();
    scene_fails(
        &project,
        "scene.camera.fov_deg=wide",
        2,
        "error: --set scene.camera.fov_deg=wide: scene.camera.fov_deg is the string \"wide\", \
         accepted: a number",
    );
}

#[test]
fn a_value_out_of_range_is_told_with_its_line() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write(
        "pipeline.toml",
        text.replace("fov_deg = 40.0", "fov_deg = 200.0"),
    );
    project.run(SCENE, &[]).expect_error(
        2,
        "error: pipeline.toml:12: scene.camera.fov_deg is 200; accepted: a vertical field of view \
         between 0 and 180 degrees, for instance fov_deg = 40.0",
    );
}

#[test]
fn composite_keys_are_checked_before_anything_is_read() {
    let project = Project::new();
    scene_fails(
        &project,
        "composite.tone=filmic",
        2,
        "error: --set composite.tone=filmic: composite.tone is \"filmic\", accepted: \"none\", \
         \"reinhard\"",
    );
    // A flag takes the place of the file's other key, but not of another flag.
    let budget = ["--set", "composite.time_budget_s=3"];
    project.run(SCENE, &budget).expect_success();
    let both = [&budget[..], &["--set", "composite.target_error=0.01"]].concat();
    project.run(SCENE, &both).expect_error(
        2,
        "error: --set composite.time_budget_s=3: composite.time_budget_s: excludes target_error; \
         keep one of the two",
    );
}

#[test]
fn a_missing_configuration_points_at_the_option() {
    let project = Project::new();
    project.run(SCENE, &["-p", "none.toml"]).expect_error(
        2,
        "error: cannot read none.toml: no such file or directory; name another file with --pipeline",
    );
}

#[test]
fn a_photograph_beyond_the_configured_limit_is_refused() {
    scene_fails(
        &Project::new(),
        "scene.limits.photo_megapixels=0",
        1,
        "error: the scene cannot be set up\n  caused by: `background.png` is 36 x 24 pixels (0.0 \
         megapixels); the limit is 0: scale it down, or raise scene.limits.photo_megapixels",
    );
}

#[test]
fn a_missing_object_is_named() {
    scene_fails(
        &Project::new(),
        "scene.objects.0.path=none.glb",
        1,
        "error: the scene cannot be set up\n  caused by: cannot read the object \"none.glb\": No \
         such file or directory",
    );
}

#[test]
fn a_photo_of_zero_bytes_is_named() {
    let project = Project::new();
    project.write("zero.png", "");
    scene_fails(
        &project,
        "scene.background=zero.png",
        1,
        "error: the scene cannot be set up\n  caused by: `zero.png` is empty (0 bytes); expected a \
         PNG, JPEG, OpenEXR or Radiance HDR image: export the file again",
    );
}

#[test]
fn a_missing_texture_is_a_warning_with_its_name() {
    let project = Project::new();
    project.write("object.obj", format!("mtllib a.mtl\nusemtl m\n{OBJECT}"));
    project.write("a.mtl", "newmtl m\nmap_Kd lost.png\n");
    let run = project.run(SCENE, &[]);
    run.expect_success();
    let warning = "warning: \"object.obj\": the texture \"lost.png\" cannot be read (No such file or directory";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
}

#[test]
fn a_glb_that_is_cut_short_is_told_with_both_lengths() {
    let project = Project::new();
    let mut glb = b"glTF".to_vec();
    glb.extend(2u32.to_le_bytes());
    glb.extend(5000u32.to_le_bytes());
    glb.extend([0; 12]);
    project.write("cut.glb", glb);
    scene_fails(
        &project,
        "scene.objects.0.path=cut.glb",
        1,
        "error: the scene cannot be set up\n  caused by: \"cut.glb\": the GLB header announces 5000 \
         bytes, the file has 24: it is cut short; export or copy the file again",
    );
}

#[test]
fn an_index_out_of_range_is_told_with_its_line() {
    let project = Project::new();
    project.write("object.obj", OBJECT.replace("f 2 3 4", "f 2 3 9"));
    scene_fails(
        &project,
        "scene.class=toy",
        1,
        "error: the scene cannot be set up\n  caused by: \"object.obj\": line 7: a face refers to \
         9, but there are 4 vertices (v) so far; export the file again",
    );
}

#[test]
fn positions_that_are_not_numbers_are_told_with_their_vertex() {
    let project = Project::new();
    project.write("object.obj", OBJECT.replace("v 0.6 0 0.5", "v nan 0 0.5"));
    scene_fails(
        &project,
        "scene.class=toy",
        1,
        "error: the scene cannot be set up\n  caused by: \"object.obj\": vertices (v), element 2 is \
         (NaN, 0, 0.5), which is not finite; repair the mesh and export it again",
    );
}

#[test]
fn a_required_extension_that_cannot_be_ignored_is_named() {
    let project = Project::new();
    project.write(
        "packed.gltf",
        r#"{"asset": {"version": "2.0"}, "extensionsUsed": ["KHR_draco_mesh_compression"],
            "extensionsRequired": ["KHR_draco_mesh_compression"]}"#,
    );
    scene_fails(
        &project,
        "scene.objects.0.path=packed.gltf",
        1,
        "error: the scene cannot be set up\n  caused by: \"packed.gltf\": the file requires the glTF \
         extension KHR_draco_mesh_compression, which is not supported; convert the file: \
         gltf-transform copy IN.glb OUT.glb",
    );
}

#[test]
fn a_photo_is_no_environment_map() {
    let project = Project::new();
    project.run(SCENE, &[]).expect_success();
    let set = ["-s", "composite.environment=background.png"];
    project.run(COMPOSITE, &set).expect_error(
        1,
        "error: cannot use composite.environment = \"background.png\"\n  caused by: \
         `background.png` is a PNG image (display-referred); expected an OpenEXR or Radiance HDR \
         image (linear light): convert the file",
    );
}

#[test]
fn a_stage_that_lacks_its_predecessor_names_it() {
    Project::new().run(COMPOSITE, &[]).expect_error(
        1,
        "error: out/scene/stage.json is missing: run dipir-scene first",
    );
}

#[test]
fn a_composite_without_any_light_says_where_to_get_one() {
    let project = Project::new();
    let text = String::from_utf8(project.read("pipeline.toml")).unwrap();
    project.write(
        "pipeline.toml",
        text.replace("environment = \"sky.exr\"", ""),
    );
    project.run(SCENE, &[]).expect_success();
    project.run(COMPOSITE, &[]).expect_error(
        1,
        "error: there is no light: [composite] environment is not set and out/light/lighting.json \
         is missing; name a map, as in --set composite.environment=sky.hdr, or run dipir-light \
         first",
    );
}

#[test]
fn light_beyond_all_numbers_is_told_by_its_cause() {
    let project = Project::new();
    let bright = EnvironmentMap::constant(16, 8, Vec3::splat(3e38));
    bright.write(project.path("bright.exr")).unwrap();
    let args = ["-s", "composite.environment=bright.exr"];
    project.run(SCENE, &args).expect_success();
    let run = project.run(COMPOSITE, &args);
    assert_eq!(run.code, Some(1), "{}", run.stderr);
    assert!(
        run.stderr.starts_with("error: the light in column ")
            && run.stderr.trim_end().ends_with(
                "of the picture is beyond what 32-bit numbers hold: lower composite.exposure_ev or emission_ev, or the \
                 radiance of the light or of what the object emits"
            ),
        "{}",
        run.stderr
    );
    assert!(!project.path("out/composite").exists());
}

#[test]
fn a_camera_beyond_the_earth_is_refused() {
    let project = Project::new();
    let run = project.run(SCENE, &["-s", "scene.camera.position=[1e38, 1.2, 4.0]"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr.contains("at most ten million from the origin"),
        "{}",
        run.stderr
    );
    project.write("shot.chan", "1 0 1.2 1e200 0 0 0 40\n");
    let run = project.run(SCENE, &["-s", "scene.camera={file=\"shot.chan\"}"]);
    assert_eq!(run.code, Some(2));
    assert!(
        run.stderr
            .contains("scene.camera.file is a camera at [0, 1.2, 1000000"),
        "{}",
        run.stderr
    );
    assert!(!project.path("out/scene").exists());
}
