//! `dipir report`: the page that shows a run.
use base64::prelude::{BASE64_STANDARD, Engine};
use serde_json::Value;

use crate::project::*;
use crate::whole::{self, run_all};

fn page(project: &Project) -> String {
    String::from_utf8(project.read("out/report.html")).unwrap()
}

/// Every element is closed by the element that was opened last.
#[track_caller]
fn assert_well_formed(page: &str) {
    let (head, rest) = page.split_once("<style>").unwrap();
    let (_, rest) = rest.split_once("</style>").unwrap();
    let (body, end) = rest.split_once("<script>").unwrap();
    let (_, end) = end.split_once("</script>").unwrap();
    let markup = format!("{head}{body}{end}");
    let mut open = Vec::new();
    for tag in markup.split('<').skip(1) {
        let (tag, _) = tag.split_once('>').expect("a tag that does not end");
        let name = tag.split_whitespace().next().unwrap();
        match name.strip_prefix('/') {
            Some(name) => assert_eq!(open.pop(), Some(name), "<{tag}>"),
            None if ["!doctype", "meta", "img", "input"].contains(&name) => {}
            // Elements of SVG that hold nothing.
            None if tag.ends_with('/') => {}
            None => open.push(name),
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

#[test]
fn the_page_shows_every_stage_and_needs_no_other_file() {
    let project = whole::project();
    run_all(&project, &[]);
    project
        .run(DIPIR, &["report", "--set", "report.truth=sky.exr"])
        .expect_success();
    let page = page(&project);
    assert_well_formed(&page);
    for part in [
        "class=\"compare\"",
        "Against the true light",
        "object (premultiplied)",
        "share of all light",
        "Tone curves",
        "Guidance",
        "iteration 15",
        " toy ",
        "Loss at fixed crops, timesteps and noise",
        "after 3 updates",
        ">memory</th",
        " MiB",
        "every material is opaque",
        "dipir-light --set report.truth=sky.exr",
    ] {
        assert!(page.contains(part), "{part}");
    }
    // Nothing is fetched: all pictures are in the page.
    for part in ["src=\"http", "url(", "@import"] {
        assert!(!page.contains(part), "{part}");
    }
    // Curves can be saved as numbers, which are in the page, too.
    let links = page.matches("href=").count();
    let files = page.matches("href=\"data:text/csv;base64,").count();
    assert!(links == files && files > 4, "{links} {files}");
    let pictures = page.matches("<img ").count();
    assert_eq!(
        pictures,
        page.matches("src=\"data:image/png;base64,").count()
    );
    assert!(pictures > 10, "{pictures}");
}

#[test]
fn the_page_shows_whatever_there_is() {
    let project = whole::project();
    project.run(DIPIR, &["report"]).expect_error(
        2,
        "error: no stage has run yet, so there is nothing to show; run dipir run first",
    );
    // As a run leaves it that ended in its first stage.
    std::fs::create_dir(project.path("out")).unwrap();
    project.run(DIPIR, &["report"]).expect_error(
        2,
        "error: no stage has run yet, so there is nothing to show; run dipir run first",
    );
    assert!(project.names("out").is_empty());
    project
        .run(DIPIR, &["run", "-q", "--until", "scene"])
        .expect_success();
    let first = page(&project);
    assert_well_formed(&first);
    assert!(first.contains("Effects") && !first.contains("class=\"compare\""));
    project.run(DIPIR, &["run", "-q"]).expect_success();
    // A run of one stage says of those that it takes as they are what holds.
    let last = ["run", "-q", "--from", "composite", "--force"];
    project.run(DIPIR, &last).expect_success();
    assert!(!page(&project).contains("nothing that is asked for reads it"));
    let mut bytes = project.read("out/composite/composite.exr");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    project.write("out/composite/composite.exr", bytes);
    project.run(DIPIR, &["report"]).expect_success();
    let damaged = page(&project);
    assert_well_formed(&damaged);
    assert!(damaged.contains("Not shown: out/composite/composite.exr: damaged"));
    assert!(damaged.contains("Effects"));
}

#[test]
fn the_photograph_on_the_page_is_the_photograph_for_every_transfer() {
    for transfer in ["srgb", "gamma22", "linear"] {
        let project = Project::new();
        let set = format!("scene.transfer={transfer}");
        project
            .run(DIPIR, &["run", "-q", "--set", &set])
            .expect_success();
        let page = page(&project);
        let (_, before) = page.split_once("<div class=\"before\"").unwrap();
        let (_, before) = before.split_once("base64,").unwrap();
        let (before, _) = before.split_once('"').unwrap();
        let shown = image::load_from_memory(&BASE64_STANDARD.decode(before).unwrap()).unwrap();
        let photo = image::load_from_memory(&project.read("background.png")).unwrap();
        let (shown, photo) = (shown.to_rgb8(), photo.to_rgb8());
        assert_eq!(shown.dimensions(), photo.dimensions());
        for (a, b) in shown.iter().zip(photo.iter()) {
            // The layers are 16-bit floats: half a 2048th of a value, less than a step of 8 bits.
            assert!(a.abs_diff(*b) <= 1, "{transfer}: {a} is not {b}");
        }
    }
}

#[test]
fn every_string_on_the_page_is_text() {
    let project = Project::new();
    let evil = "<script>alert(1)</script>";
    let set = format!("scene.class={evil}");
    let object = "a'b&<i>.obj";
    project.write(object, OBJECT);
    let path = format!("scene.objects.0.path={object}");
    project
        .run(DIPIR, &["run", "-q", "--set", &set, "--set", &path])
        .expect_success();
    let page = page(&project);
    assert_well_formed(&page);
    assert!(!page.contains(evil) && !page.contains("<i>"));
    assert!(page.contains("&lt;script&gt;alert(1)&lt;/script&gt; in background.png"));
}

#[test]
fn the_recovered_light_is_compared_with_the_true_one_once() {
    let project = whole::project();
    // What was recovered is declared the truth: light and picture agree to noise and a texel.
    let settings = [
        "light.learning_rates.tone=0",
        "composite.target_error=0.005",
        "report.truth=known.exr",
        "report.truth_tone=reinhard",
    ];
    let mut args = vec!["run", "--json"];
    args.extend(settings.iter().flat_map(|s| ["--set", s]));
    let compared = |args: &[&str]| -> Value {
        let run = project.run(DIPIR, args);
        run.expect_success();
        let value: Value = serde_json::from_str(&run.stdout).unwrap();
        value["truth"].clone()
    };
    project.write("known.exr", project.read("sky.exr"));
    assert!(compared(&args)["rmse_recovered"].is_f64());
    project.write("known.exr", project.read("out/light/environment.exr"));
    let truth = compared(&args);
    let number = |truth: &Value, key: &str| truth[key].as_f64().unwrap();
    assert!(
        number(&truth, "rmse_recovered") < 0.5 * number(&truth, "rmse_neutral"),
        "{truth}"
    );
    // Texels of that map are 22.5 degrees wide.
    assert!(number(&truth, "sun_error_deg") < 22.5, "{truth}");
    // The page says it; nothing is rendered to say it again.
    assert!(page(&project).contains("Against the true light"));
    assert_eq!(compared(&args), Value::Null);
    // What no map can be placed with is refused before anything is compared.
    for (set, message) in [
        (
            "report.truth_exposure_ev=1000",
            "1000 is out of range; accepted: stops from -64 to 64",
        ),
        (
            "report.truth_rotation_deg=nan",
            "must be a finite angle in degrees",
        ),
    ] {
        let refused = project.run(DIPIR, &["report", "--set", set]);
        assert_eq!(refused.code, Some(2), "{}", refused.stderr);
        assert!(refused.stderr.contains(message), "{}", refused.stderr);
    }
    // A stop brighter it is another light from the same side.
    let brighter = [&args[..], &["--set", "report.truth_exposure_ev=1"]].concat();
    let brighter = compared(&brighter);
    assert!(
        number(&brighter, "rmse_recovered") > number(&truth, "rmse_recovered") + 0.01,
        "{truth} {brighter}"
    );
    assert_eq!(brighter["sun_error_deg"], truth["sun_error_deg"]);
}
