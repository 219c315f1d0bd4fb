//! `dipir-evaluate`: scenes, runs, report, study.
use std::collections::HashMap;
use std::fs;
use std::path::Path;

use candle_core::{Device, Tensor};
use dipir_light::environment::EnvironmentMap;
use glam::Vec3;
use serde_json::{Value, json};

use crate::project::{EVALUATE, OBJECT, Project};

/// A project with a folder of panoramas and one of models.
fn evaluation() -> Project {
    let project = Project::new();
    fs::create_dir(project.path("maps")).unwrap();
    fs::create_dir(project.path("models")).unwrap();
    let texels = (0..64 * 32).map(|k| match (k / 64, k % 64) {
        (8..=9, 20..=22) => Vec3::splat(30.0),
        (0..=15, _) => Vec3::new(0.4, 0.5, 0.7),
        _ => Vec3::new(0.3, 0.25, 0.2),
    });
    let map = EnvironmentMap::new(64, 32, texels.collect()).unwrap();
    map.write(project.path("maps/square.exr")).unwrap();
    project.write("models/toy.obj", OBJECT);
    let make = [
        "make", "--hdri", "maps", "--models", "models", "--count", "1", "--size", "36x32",
    ];
    project.run(EVALUATE, &make).expect_success();
    project
}

/// Weights of LPIPS that tell colours and edges apart, though not as people do.
fn some_network(path: &Path) {
    let layers = [
        ("1.0", 64, 3, 11),
        ("2.3", 192, 64, 5),
        ("3.6", 384, 192, 3),
        ("4.8", 256, 384, 3),
        ("5.10", 256, 256, 3),
    ];
    let waves = |shape: &[usize]| {
        let count: usize = shape.iter().product();
        let values = (0..count).map(|i| 0.1 * (0.7 * i as f32).sin()).collect();
        Tensor::from_vec::<_, f32>(values, shape, &Device::Cpu).unwrap()
    };
    let tensors: HashMap<String, Tensor> = (0..)
        .zip(layers)
        .flat_map(|(k, (name, out, inputs, side))| {
            let linear = waves(&[1, out, 1, 1]).sqr().unwrap();
            [
                (
                    format!("net.slice{name}.weight"),
                    waves(&[out, inputs, side, side]),
                ),
                (format!("net.slice{name}.bias"), waves(&[out])),
                (format!("lin{k}.model.1.weight"), linear),
            ]
        })
        .collect();
    candle_core::safetensors::save(&tensors, path).unwrap();
}

#[test]
fn a_street_without_places_is_refused() {
    let project = evaluation();
    let make = ["make", "--hdri", "maps", "--places", "street"];
    let told = "error: --places is about generated places: say how many with --generated";
    project.run(EVALUATE, &make).expect_error(2, told);
}

#[test]
fn two_lights_are_compared_by_three_spheres() {
    let project = evaluation();
    let grey = EnvironmentMap::constant(64, 32, Vec3::splat(0.5));
    grey.write(project.path("grey.exr")).unwrap();
    let compared = |estimate: &str| -> Value {
        let arguments = ["spheres", "--json", "maps/square.exr", estimate];
        let run = project.run(EVALUATE, &arguments);
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        value["spheres"].clone()
    };
    let number = |spheres: &Value, k: usize, key: &str| spheres[k]["linear"][key].as_f64().unwrap();
    let (same, grey) = (compared("maps/square.exr"), compared("grey.exr"));
    for k in 0..3 {
        assert_eq!(number(&same, k, "rmse"), 0.0);
        assert!(number(&grey, k, "si_rmse") > 0.01, "{grey}");
    }
    let picture = [
        "spheres",
        "maps/square.exr",
        "grey.exr",
        "--png",
        "spheres.png",
    ];
    project.run(EVALUATE, &picture).expect_success();
    assert!(project.path("spheres.png").is_file());
}

#[test]
fn scenes_are_reported_by_kind_of_place() {
    let project = evaluation();
    project.write("kinds.tsv", "square\toutdoors\n");
    fs::remove_dir_all(project.path("evaluation")).unwrap();
    let make = [
        "make",
        "--hdri",
        "maps",
        "--models",
        "models",
        "--count",
        "1",
        "--size",
        "36x32",
        "--kinds",
        "kinds.tsv",
    ];
    project.run(EVALUATE, &make).expect_success();
    let run = ["run", "--target-error", "0.05", "--method", "neutral"];
    project.run(EVALUATE, &run).expect_success();
    project.run(EVALUATE, &["report"]).expect_success();
    let table = String::from_utf8(project.read("evaluation/report.md")).unwrap();
    assert!(table.contains("| outdoors | 1 |"), "{table}");
}

#[test]
fn methods_run_once_and_are_reported_and_asked_about() {
    let project = evaluation();
    let run = [
        "run",
        "--target-error",
        "0.05",
        "--method",
        "neutral",
        "--method",
        "projected",
    ];
    project.run(EVALUATE, &run).expect_success();
    let score = "evaluation/runs/neutral/000-square-toy/score.json";
    let first = project.read(score);
    project.run(EVALUATE, &run).expect_success();
    // Seconds differ from run to run: the same bytes mean that it did not run again.
    assert_eq!(project.read(score), first);
    let first: Value = serde_json::from_slice(&first).unwrap();
    assert!(
        first["picture"]["rmse_touched"].as_f64().unwrap() > 0.01,
        "{first}"
    );

    project.run(EVALUATE, &["report"]).expect_success();
    let report: Value = serde_json::from_slice(&project.read("evaluation/report.json")).unwrap();
    assert_eq!(report["methods"].as_array().unwrap().len(), 2);
    let page = String::from_utf8(project.read("evaluation/report.html")).unwrap();
    // The photograph, the truth, and both methods.
    assert_eq!(page.matches("data:image/png;base64,").count(), 4);
    assert!(page.contains("Photograph projected") && !page.contains("http"));

    // Weights that are not there, and weights that are.
    let table = || String::from_utf8(project.read("evaluation/report.csv")).unwrap();
    assert!(!table().contains("LPIPS"));
    let lpips = ["report", "--lpips", "alex.safetensors"];
    let told = "error: cannot use alex.safetensors: No such file or directory; it must hold the tensors of \
                lpips.LPIPS(net=\"alex\").state_dict()";
    project.run(EVALUATE, &lpips).expect_error(1, told);
    some_network(&project.path("alex.safetensors"));
    project.run(EVALUATE, &lpips).expect_success();
    let report: Value = serde_json::from_slice(&project.read("evaluation/report.json")).unwrap();
    let [neutral, projected] =
        [0, 1].map(|k| report["methods"][k]["scores"][0]["lpips"].as_f64().unwrap());
    assert!(
        neutral > 0.0 && projected > 0.0 && neutral != projected,
        "{report}"
    );
    assert!(table().contains("\"LPIPS\""));

    project
        .run(EVALUATE, &["study", "page", "--method", "projected"])
        .expect_success();
    let page = String::from_utf8(project.read("evaluation/study.html")).unwrap();
    assert!(page.contains("\"scene\":\"000-square-toy\""));
    let choice = json!({"scene": "000-square-toy", "preferred": "projected", "over": "neutral"});
    let answers = json!({"participant": "a", "seed": 1, "choices": [choice]});
    project.write("answers.json", answers.to_string());
    let count = [
        "study",
        "count",
        "answers.json",
        "--method",
        "projected",
        "--json",
    ];
    let counted = project.run(EVALUATE, &count);
    counted.expect_success();
    let counted: Value = serde_json::from_str(&counted.stdout).unwrap();
    assert_eq!(counted["verdicts"][0]["preferred"], 1.0);
}

#[test]
fn another_estimator_s_maps_are_a_method_and_the_truth_itself_is_the_best() {
    let project = evaluation();
    fs::create_dir(project.path("estimates")).unwrap();
    // What the truth is, on the photograph's scale.
    let info = project.read("evaluation/scenes/000-square-toy/scene.json");
    let info: Value = serde_json::from_slice(&info).unwrap();
    let scale = info["exposure_ev"].as_f64().unwrap().exp2() as f32;
    let map = EnvironmentMap::read(project.path("maps/square.exr"))
        .unwrap()
        .scaled(scale);
    map.write(project.path("estimates/000-square-toy.exr"))
        .unwrap();
    let run = [
        "run",
        "--target-error",
        "0.02",
        "--environment-from",
        "estimates",
    ];
    project.run(EVALUATE, &run).expect_success();
    let score = project.read("evaluation/runs/estimates/000-square-toy/score.json");
    let score: Value = serde_json::from_slice(&score).unwrap();
    // Noise of both pictures, the method's and the truth's.
    assert!(
        score["picture"]["rmse_touched"].as_f64().unwrap() < 0.03,
        "{score}"
    );
    assert!(
        score["light"]["peak_deg"].as_f64().unwrap() < 0.1,
        "{score}"
    );
}

#[test]
fn what_cannot_be_done_is_said_in_one_sentence() {
    let project = Project::new();
    let run = |arguments: &[&str]| project.run(EVALUATE, arguments);
    run(&["make"]).expect_error(
        2,
        "error: there is nothing to make scenes from: name a folder of panoramas with --hdri, \
         or a number of generated places with --generated",
    );
    run(&["run"]).expect_error(
        1,
        "error: there is no scene in evaluation/scenes; make some with dipir-evaluate make",
    );
    fs::create_dir(project.path("empty")).unwrap();
    run(&["make", "--hdri", "empty"]).expect_error(
        2,
        "error: there are no panoramas in empty; accepted: .hdr, .exr",
    );
}

#[test]
fn a_generated_place_is_lit_by_the_map_beside_it() {
    let project = Project::new();
    let make = ["make", "--generated", "1", "--size", "24x24"];
    project.run(EVALUATE, &make).expect_success();
    let scenes: Vec<_> = fs::read_dir(project.path("evaluation/scenes"))
        .unwrap()
        .map(|e| e.unwrap().file_name().into_string().unwrap())
        .collect();
    let [name] = &scenes[..] else {
        panic!("{scenes:?}");
    };
    let run = [
        "run",
        "--target-error",
        "0.05",
        "--method",
        "neutral",
        "--method",
        "fitted",
    ];
    project.run(EVALUATE, &run).expect_success();
    let rmse = |method: &str| {
        let score = project.read(&format!("evaluation/runs/{method}/{name}/score.json"));
        let score: Value = serde_json::from_slice(&score).unwrap();
        score["picture"]["rmse_touched"].as_f64().unwrap()
    };
    assert!(
        rmse("fitted") < 0.5 * rmse("neutral"),
        "{} beside {}",
        rmse("fitted"),
        rmse("neutral")
    );
}
