//! The configuration of every method, looked at before anything runs.
use std::path::Path;

use clap::Parser;
use dipir_cli::exit::{self, Usage, describe};
use dipir_cli::session::Session;
use dipir_stages::command_line::light::Cli;
use dipir_stages::graph::{graph, plan};
use dipir_stages::names;

use crate::chosen::Chosen;
use crate::folder::SceneInfo;
use crate::methods::Source;
use crate::runner::{Runner, toml_string};

impl Runner<'_> {
    /// Refuses what a stage would refuse of the configuration of `scene`: first of what the command line sets, then of
    /// each method.
    pub fn check(&self, scene: &SceneInfo) -> anyhow::Result<()> {
        let folder = self.evaluation.scene(&scene.name);
        let pipeline = folder.join("pipeline.toml");
        // Nothing is there yet, so that only what the configuration says is looked at.
        let out = self.evaluation.work(&scene.name, "check");
        let common = self.common_settings()?;
        let read = open(&pipeline, &out, &common).and_then(|session| graph(&session));
        read.map_err(in_one_line)?;
        for chosen in &self.methods {
            let mut set = self.settings(chosen)?;
            if chosen.method.light != Source::Recovered {
                let map = toml_string(&folder.join(&scene.map))?;
                set.push(format!("composite.environment={map}"));
                set.push(format!("composite.tone={}", scene.tone.key()));
            }
            check_method(chosen, &pipeline, &out, &set).map_err(|e| {
                let text = format!("the method \"{}\": {}", chosen.method.name, one_line(&e));
                anyhow::Error::new(Usage(text))
            })?;
        }
        Ok(())
    }
}

/// Plans the stages of a method; what is wrong with files or with stages that have not run yet is no error here.
fn check_method(
    chosen: &Chosen,
    pipeline: &Path,
    out: &Path,
    set: &[String],
) -> anyhow::Result<()> {
    let session = open(pipeline, out, set)?;
    graph(&session)?;
    let before = chosen.method.stages.iter().map(String::as_str);
    for stage in before.chain([names::COMPOSITE.name]) {
        match plan(&session, stage) {
            Err(e) if exit::code_of(&e) == exit::USAGE => return Err(e),
            _ => {}
        }
    }
    Ok(())
}

/// A session as the stages open it.
fn open(pipeline: &Path, out: &Path, set: &[String]) -> anyhow::Result<Session> {
    let paths = [pipeline, out].map(|p| p.as_os_str().to_owned());
    let [pipeline, out] = paths;
    let mut typed = vec![
        "dipir-light".into(),
        "-q".into(),
        "-p".into(),
        pipeline,
        "-o".into(),
        out,
    ];
    for pair in set {
        typed.extend(["--set".into(), pair.into()]);
    }
    Session::open(&Cli::try_parse_from(typed)?.common)
}

fn one_line(error: &anyhow::Error) -> String {
    describe(error).replace("\n  caused by", "")
}

fn in_one_line(error: anyhow::Error) -> anyhow::Error {
    match exit::code_of(&error) {
        exit::USAGE => Usage(one_line(&error)).into(),
        _ => error,
    }
}

#[cfg(test)]
mod tests {
    use dipir_cli::executables::Executables;
    use dipir_evaluation::results::write;
    use serde_json::json;

    use super::*;
    use crate::chosen::choose;
    use crate::chosen::tests::arguments;
    use crate::folder::EvaluationFolder;
    use crate::parts::Parts;

    /// What is said of a scene under the arguments of a run.
    fn said(typed: &[&str]) -> anyhow::Result<()> {
        let folder = tempfile::tempdir()?;
        let evaluation = EvaluationFolder::new(folder.path());
        let pipeline = "[scene]\nbackground = \"photo.png\"\n[[scene.objects]]\npath = \"a.obj\"\nposition = [0.0, 0.0, 0.0]\n\
                        [scene.camera]\nposition = [0.0, 1.6, 5.0]\nlook_at = [0.0, 0.5, 0.0]\nfov_deg = 40.0\n";
        write(&evaluation.scene("a").join("pipeline.toml"), pipeline)?;
        let scene: SceneInfo = serde_json::from_value(json!({"name": "a", "made_from": "",
            "map": "map.exr", "exposure_ev": 0.0, "tone": "none"}))?;
        let args = arguments(typed);
        let runner = Runner {
            evaluation,
            executables: Executables::beside_this()?,
            methods: choose(&args, &|_| {})?,
            args: &args,
            threads: 1,
            parts: Parts::default(),
        };
        runner.check(&scene)
    }

    #[test]
    fn all_built_in_methods_pass() {
        said(&["-s", "lora.steps=3", "-s", "concepts.cache=concepts"]).unwrap();
    }

    #[test]
    fn a_wrong_setting_is_one_line_about_the_command_line() {
        let refused = |typed: &[&str]| {
            let error = said(typed).unwrap_err();
            assert_eq!(exit::code_of(&error), exit::USAGE, "{error:#}");
            let text = describe(&error);
            assert!(!text.contains('\n'), "{text}");
            text
        };
        let text = refused(&["-s", "lora.stepps=3"]);
        assert!(
            text.starts_with("--set lora.stepps=3: unknown key \"lora.stepps\""),
            "{text}"
        );
        assert!(refused(&["-s", "lora.steps=many"]).starts_with("--set lora.steps=many: "));
        assert!(refused(&["-s", "steps=3"]).starts_with("--set steps=3: \"steps\" names no table"));
        // Only what a stage of the method reads finds this.
        let text = refused(&["--method", "ours", "-s", "light.candidate=2"]);
        assert!(
            text.starts_with("the method \"ours\": --set light.candidate=2: light.candidate: only"),
            "{text}"
        );
    }
}
