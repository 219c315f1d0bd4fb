//! `report.html`: one page that shows a run, complete in itself.
//!
//! It shows the stages that have run. Where an artifact cannot be read, its section says why.
mod curves;
mod direction;
mod frames;
pub mod html;
mod learning;
mod lighting;
pub mod picture;
mod result;
mod stages;

use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cli::exit::describe;
use dipir_cli::session::Session;
use dipir_pipeline::config::TABLES;
use dipir_pipeline::manifest::{FILE_NAME, Manifest};
use dipir_pipeline::status::StageStatus;
use dipir_scene::config::SceneConfig;

use crate::names::{self, StageName};
use crate::shot;
use crate::truth::Truth;
use html::Html;
pub use stages::quoted;

/// How every page begins. A file that begins otherwise is not the program's own, and stays.
pub const MARK: &[u8] =
    b"<!doctype html>\n<html lang=\"en\"><head><meta name=\"generator\" content=\"dipir ";
/// Name of the file in the folder of artifacts.
pub const FILE: &str = "report.html";
/// Raised whenever the same artifacts give another page.
const VERSION: u32 = 8;

/// What the page shows in addition to the artifacts.
pub struct Report<'a> {
    /// The configuration and the folder of artifacts.
    pub session: &'a Session,
    /// The state of every stage.
    pub status: &'a [StageStatus],
    /// Options that repeat this run on the command line of any executable.
    pub options: &'a [String],
    /// The comparison with the true light, where that is known.
    pub truth: Option<&'a Truth>,
    /// Frames of a shot that have just failed.
    pub failed: &'a [String],
}

/// A section: its markup, nothing without its artifacts, or why it cannot be shown.
type Section = anyhow::Result<Option<Html>>;

impl Report<'_> {
    /// Writes the page and returns where it is.
    pub fn write(&self) -> anyhow::Result<PathBuf> {
        let path = self.session.out.join(FILE);
        dipir_files::replace(&path, self.page()?.as_bytes(), MARK).map_err(|e| {
            let way_out = match e.kind() {
                std::io::ErrorKind::AlreadyExists => {
                    "; move it away or choose another folder with --out"
                }
                _ => "",
            };
            let reason = dipir_pipeline::manifest::plain_reason(&e);
            anyhow::anyhow!("cannot write {}: {reason}{way_out}", path.display())
        })?;
        Ok(path)
    }

    fn page(&self) -> anyhow::Result<String> {
        let scene: SceneConfig = self.session.config.table("scene")?;
        let class = scene.class.as_deref().unwrap_or("object");
        let photo = scene.background.unwrap_or_default();
        let title = format!("{class} in {}", photo.display());
        let small = result::small(self);
        let of_composite = |section: fn(&Self, &result::Small) -> Section| match &small {
            Ok(Some(small)) => section(self, small),
            Ok(None) => Ok(None),
            Err(e) => Err(anyhow::anyhow!("{}", describe(e))),
        };
        let sections: [(&str, Section); 9] = [
            ("", of_composite(result::before_and_after)),
            ("Against the true light", Ok(self.truth.map(result::truth))),
            ("Frames", frames::section(self)),
            ("Stages", stages::table(self)),
            ("Layers", of_composite(result::layers)),
            ("Light and tone", lighting::section(self)),
            ("Personalisation", learning::section(self)),
            ("Effects", stages::effects(self)),
            ("Run a stage again", Ok(Some(stages::commands(self)))),
        ];
        let body = sections.into_iter().filter_map(|(name, section)| {
            let content = match section {
                Ok(content) => content?,
                Err(e) => Html::element(
                    "p",
                    &[("class", "soft")],
                    [Html::text(format!("Not shown: {}", describe(&e)))],
                ),
            };
            let head = (!name.is_empty()).then(|| Html::of("h2", name));
            Some(Html::all(head.into_iter().chain([content])))
        });
        let head = [
            Html::element(
                "meta",
                &[
                    ("name", "generator"),
                    ("content", concat!("dipir ", env!("CARGO_PKG_VERSION"))),
                ],
                [],
            ),
            Html::element("meta", &[("charset", "utf-8")], []),
            Html::element(
                "meta",
                &[
                    ("name", "viewport"),
                    ("content", "width=device-width, initial-scale=1"),
                ],
                [],
            ),
            Html::element(
                "meta",
                &[("name", KEY), ("content", &key(self.session)?)],
                [],
            ),
            Html::of("title", format!("{title} – dipir")),
            Html::code("style", include_str!("report/style.css")),
            Html::code("style", dipir_plotting::STYLE),
        ];
        let intro = [
            Html::of("h1", &title),
            Html::element(
                "p",
                &[("class", "soft")],
                [Html::text(format!(
                    "{}, seed {}, {} quality, dipir {}",
                    self.session.config.path().display(),
                    self.session.pipeline.seed,
                    format!("{:?}", self.session.pipeline.quality).to_lowercase(),
                    env!("CARGO_PKG_VERSION"),
                ))],
            ),
        ];
        let script = Html::code("script", include_str!("report/script.js"));
        let page = Html::element(
            "html",
            &[("lang", "en")],
            [
                Html::element("head", &[], head),
                Html::element("body", &[], intro.into_iter().chain(body).chain([script])),
            ],
        );
        Ok(format!("<!doctype html>\n{}\n", page.into_string()))
    }

    /// A stage's folder and manifest, if it has run.
    fn stage(&self, stage: &str) -> anyhow::Result<Option<(PathBuf, Manifest)>> {
        let folder = self.session.stage_folder(stage);
        if !folder.join(FILE_NAME).is_file() {
            return Ok(None);
        }
        let manifest = Manifest::read(&folder, "")?;
        Ok(Some((folder, manifest)))
    }
}

/// The page's own name for what it was made of.
const KEY: &str = "dipir-made-of";

/// Whether the page that is there shows the artifacts that are there.
pub fn is_current(session: &Session) -> bool {
    let page = dipir_files::read_to_string(session.out.join(FILE));
    match (page, key(session)) {
        (Ok(page), Ok(key)) => page.contains(&format!("name=\"{KEY}\" content=\"{key}\"")),
        _ => false,
    }
}

/// Whether any stage has left something that a page can show.
pub fn has_anything(session: &Session) -> bool {
    // What cannot be looked at may be there: reading it says why not.
    let is_there = |path: PathBuf| path.try_exists().unwrap_or(true);
    let has_run = |stage: &&StageName| is_there(stage.folder(session).join(FILE_NAME));
    names::ALL.iter().any(has_run) || shot::folders(&session.out).iter().any(|f| shot::is_made(f))
}

/// A hash of what the page is made of: the configuration, by which it says what is up to date; what amended that, which it
/// repeats in commands; every stage's manifest, which names its files by hash; that of every frame's picture; and what is
/// compared with.
fn key(session: &Session) -> anyhow::Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("report {VERSION}").as_bytes());
    for table in TABLES {
        let content: serde_json::Value = session.config.table(table)?;
        hasher.update(&serde_json::to_vec(&content)?);
    }
    let amended = (session.config.overrides(), session.pipeline.seed);
    hasher.update(&serde_json::to_vec(&amended)?);
    for stage in names::ALL {
        let manifest = std::fs::read(stage.folder(session).join(FILE_NAME));
        hasher.update(&manifest.unwrap_or_default());
        hasher.update(b"|");
    }
    for frame in shot::folders(&session.out) {
        let manifest = std::fs::read(frame.join(names::COMPOSITE.name).join(FILE_NAME));
        hasher.update(frame.to_string_lossy().as_bytes());
        hasher.update(&manifest.unwrap_or_default());
        hasher.update(b"|");
    }
    hasher.update(&serde_json::to_vec(&crate::truth::key(session)?)?);
    Ok(hasher.finalize().to_hex()[..32].to_string())
}

/// A stage's JSON, checked by hash.
fn json<T: serde::de::DeserializeOwned>(
    (folder, manifest): &(PathBuf, Manifest),
    role: &str,
) -> anyhow::Result<T> {
    let path = manifest.output(folder, role)?;
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_str(&text).with_context(|| format!("cannot understand {}", path.display()))
}

/// Every output of a role, in the order of the manifest: its name and where it is.
fn outputs((folder, manifest): &(PathBuf, Manifest), role: &str) -> Vec<(String, PathBuf)> {
    let found = manifest.outputs.iter().filter(|a| a.role == role);
    let stem = |p: &Path| {
        p.file_stem()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned()
    };
    found
        .map(|a| (stem(&a.path), folder.join(&a.path)))
        .collect()
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::command_line::scene::Cli;

    #[test]
    fn a_page_is_current_only_for_the_settings_that_it_was_made_with() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipeline.toml");
        std::fs::create_dir(folder.path().join("out")).unwrap();
        let write = |class: &str| {
            let text = format!("[scene]\nbackground = \"photo.png\"\nclass = \"{class}\"\n");
            std::fs::write(&file, text).unwrap();
        };
        write("toy");
        let path = file.display().to_string();
        let session = |more: &[&str]| {
            let args = [&["dipir-scene", "-q", "-p", path.as_str()], more].concat();
            Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap()
        };
        // No manifest holds it.
        let amended = ["--set", "scene.class=car"];
        let page = |session: &Session| {
            let report = Report {
                session,
                status: &[],
                options: &[],
                truth: None,
                failed: &[],
            };
            report.write().unwrap();
        };
        page(&session(&amended));
        assert!(is_current(&session(&amended)));
        for other in [&[][..], &["--seed", "1"], &["--set", "scene.class=toy"]] {
            assert!(!is_current(&session(other)), "{other:?}");
        }
        page(&session(&[]));
        assert!(is_current(&session(&[])));
        write("car");
        assert!(!is_current(&session(&[])));
    }

    #[test]
    fn there_is_nothing_to_show_until_a_stage_has_run() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pipeline.toml");
        std::fs::write(&file, "[scene]\nbackground = \"photo.png\"\n").unwrap();
        let path = file.display().to_string();
        let args = ["dipir-scene", "-q", "-p", path.as_str()];
        let session = Session::open(&Cli::try_parse_from(args).unwrap().common).unwrap();
        assert!(!has_anything(&session));
        // As a run leaves it that was killed in its first stage.
        std::fs::create_dir_all(session.out.join(".scene.partial")).unwrap();
        assert!(!has_anything(&session));
        let plan = names::SCENE.plan(&session, serde_json::Value::Null);
        session.begin(plan).unwrap().finish().unwrap();
        assert!(has_anything(&session));
    }
}
