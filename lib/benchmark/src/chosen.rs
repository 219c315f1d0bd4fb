//! Which methods run, with which models, and whether the options of a run fit them.
use std::path::{Path, PathBuf};

use anyhow::Context;
use dipir_cli::exit::Usage;
use dipir_prior::encoder;

use crate::command_line::RunArgs;
use crate::definition::UsedModel;
use crate::folder::TRUTH;
use crate::methods::{self, MODEL_PATH, Method, Source, key_of};

/// A method that runs.
#[derive(Debug)]
pub struct Chosen {
    /// Its row, without the path of its model.
    pub method: Method,
    /// The folder of its maps, if those are imported.
    pub maps: Option<PathBuf>,
    /// The diffusion model, if one is asked.
    pub model: Option<ChosenModel>,
}

impl Chosen {
    /// Hash of the diffusion model, if one is asked.
    pub fn digest(&self) -> Option<&str> {
        self.model.as_ref().map(|m| m.used.digest.as_str())
    }
}

/// The diffusion model of a method.
#[derive(Clone, Debug)]
pub struct ChosenModel {
    /// Where it is; absent for the embedded one.
    pub file: Option<PathBuf>,
    /// What scores say of it.
    pub used: UsedModel,
}

/// The methods that `args` ask for. `note` gets a line for each that cannot run with its model and is left out.
///
/// # Errors
/// If the arguments name what is not there, two methods have one name, no method is left, or `--set` sets what a
/// method sets itself.
pub fn choose(args: &RunArgs, note: &dyn Fn(&str)) -> anyhow::Result<Vec<Chosen>> {
    let mut chosen = Vec::new();
    let mut left_out = Vec::new();
    for (mut method, maps) in named(args)? {
        let path = model_path(args, &method);
        method.set.retain(|s| key_of(s) != MODEL_PATH);
        if let Some(why) = blind(&method, path.as_ref()) {
            note(&why);
            left_out.push(why);
            continue;
        }
        let model = method.model.then(|| model(path)).transpose()?;
        chosen.push(Chosen {
            method,
            maps,
            model,
        });
    }
    if chosen.is_empty() {
        let why = format!("no method is left to run: {}", left_out.join("; "));
        return Err(Usage(why).into());
    }
    refuse_set(&args.set, &chosen)?;
    note_scenes(&args.set, note);
    Ok(chosen)
}

/// The rows that `args` name, with the folder of their maps if those are imported.
fn named(args: &RunArgs) -> anyhow::Result<Vec<(Method, Option<PathBuf>)>> {
    let all = methods::read(args.methods.as_deref())?;
    let mut imported: Vec<(Method, Option<PathBuf>)> = Vec::new();
    for folder in &args.environment_from {
        let method = methods::imported(folder)?;
        let mut taken = all.iter().chain(imported.iter().map(|(m, _)| m));
        if taken.any(|m| m.name == method.name) {
            let text = format!(
                "--environment-from {}: there is another method called \"{}\"; give the folder another name",
                folder.display(),
                method.name
            );
            return Err(Usage(text).into());
        }
        imported.push((method, Some(folder.clone())));
    }
    for name in &args.method {
        let names = || all.iter().chain(imported.iter().map(|(m, _)| m));
        if !names().any(|m| m.name == *name) {
            let names: Vec<&str> = names().map(|m| m.name.as_str()).collect();
            return Err(Usage(format!("--method {name}: accepted: {}", names.join(", "))).into());
        }
    }
    // Folders of maps alone run where no method is named.
    let are_all = args.method.is_empty() && args.environment_from.is_empty();
    let chosen = all
        .into_iter()
        .filter(|m| are_all || args.method.contains(&m.name))
        .map(|m| (m, None))
        .chain(imported);
    let chosen: Vec<_> = chosen.collect();
    if chosen.iter().any(|(m, _)| m.name == TRUTH) {
        return Err(Usage(format!("no method may be called \"{TRUTH}\"")).into());
    }
    Ok(chosen)
}

/// A model as it was named, and where it is.
struct Named {
    text: String,
    file: PathBuf,
}

/// The model of `method`: that of its row, from the folder of the file that the row is in, before that of `--model`.
fn model_path(args: &RunArgs, method: &Method) -> Option<Named> {
    if let Some(text) = method.value(MODEL_PATH) {
        let folder = args.methods.as_deref().and_then(Path::parent);
        let file = folder.unwrap_or(Path::new("")).join(&text);
        return Some(Named { text, file });
    }
    args.model.as_ref().map(|path| Named {
        text: path.display().to_string(),
        file: path.clone(),
    })
}

/// Why `method` cannot run with its model: it starts at the light that the model reads.
fn blind(method: &Method, path: Option<&Named>) -> Option<String> {
    let reads = method.value("light.start");
    let reads = reads.is_some_and(|start| ["read", "encoder"].contains(&start.as_str()));
    let path = path.filter(|p| method.model && reads && p.file.exists())?;
    (!path.file.join(encoder::FILE).is_file()).then(|| {
        format!(
            "the method \"{}\" is left out: it needs a model that knows light, and {} has no {}",
            method.name,
            path.text,
            encoder::FILE
        )
    })
}

fn model(path: Option<Named>) -> anyhow::Result<ChosenModel> {
    let file = match &path {
        Some(Named { text, file }) => Some(file.canonicalize().map_err(|_| {
            let text = format!("there is no model in {text}; name a folder or a .safetensors file");
            Usage(text)
        })?),
        None => None,
    };
    let digest = dipir_stages::model::digest(file.as_deref()).context("cannot read the model")?;
    let used = UsedModel {
        path: path.map(|p| p.text),
        digest,
    };
    Ok(ChosenModel { file, used })
}

/// Refuses what `--set` sets and a method, or another option, does.
fn refuse_set(set: &[String], chosen: &[Chosen]) -> anyhow::Result<()> {
    for pair in set.iter().filter(|s| s.contains('=')) {
        let key = key_of(pair);
        for (own, instead) in [
            (MODEL_PATH, "use --model for that"),
            ("composite.target_error", "use --target-error for that"),
            ("pipeline.seed", "every method has seed 0"),
            ("pipeline.out", "use --out for that"),
        ] {
            if overlap(&key, own) {
                return Err(Usage(format!("--set {pair}: {instead}")).into());
            }
        }
        for Chosen { method, .. } in chosen {
            let of_map: &[&str] = match method.light {
                // A map would take the place of what is recovered.
                Source::Recovered => &["composite.environment"],
                _ => &["composite.environment", "composite.tone"],
            };
            let own = method.set.iter().map(|s| key_of(s));
            let mut own = own.chain(of_map.iter().map(|k| (*k).to_owned()));
            if let Some(own) = own.find(|own| overlap(&key, own)) {
                let text = format!(
                    "--set {pair}: the method \"{}\" sets {own} itself, which makes it what it is; leave that \
                     method out by naming others with --method, or write a row of your own for --methods",
                    method.name
                );
                return Err(Usage(text).into());
            }
        }
    }
    Ok(())
}

/// Notes what `--set` changes of the scenes: methods see it, the true pictures do not.
fn note_scenes(set: &[String], note: &dyn Fn(&str)) {
    let parts = [
        "background",
        "transfer",
        "occluders",
        "depth",
        "depth_kind",
        "depth_scale",
        "depth_surfaces",
        "objects",
        "camera",
        "proxy",
    ];
    for pair in set.iter().filter(|s| s.contains('=')) {
        let key = key_of(pair);
        if parts.iter().any(|p| overlap(&key, &format!("scene.{p}"))) {
            note(&format!(
                "--set {pair}: the true pictures show the scenes as they were made, so that scores count the \
                 difference; to change a scene, edit its pipeline.toml"
            ));
        }
    }
}

/// Whether one of the dotted keys is the other, or a table around it.
fn overlap(a: &str, b: &str) -> bool {
    let is_in = |a: &str, b: &str| {
        a.strip_prefix(b)
            .is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    is_in(a, b) || is_in(b, a)
}

#[cfg(test)]
pub(crate) mod tests {
    use std::cell::RefCell;
    use std::fs;

    use clap::Parser;

    use super::*;
    use crate::command_line::{Cli, Command};

    /// The arguments of `dipir-evaluate run`.
    pub(crate) fn arguments(typed: &[&str]) -> RunArgs {
        let all = ["dipir-evaluate", "run"].iter().chain(typed);
        match Cli::try_parse_from(all).unwrap().command {
            Command::Run(args) => args,
            _ => unreachable!("a run was typed"),
        }
    }

    /// A method's name and the path of its model.
    type Named = (String, Option<String>);

    /// The chosen methods, and what was noted.
    fn chosen(typed: &[&str]) -> anyhow::Result<(Vec<Named>, Vec<String>)> {
        let notes = RefCell::new(Vec::new());
        let all = choose(&arguments(typed), &|line| {
            notes.borrow_mut().push(line.to_owned())
        })?;
        let path = |c: &Chosen| c.model.as_ref().and_then(|m| m.used.path.clone());
        let named = all.iter().map(|c| (c.method.name.clone(), path(c)));
        Ok((named.collect(), notes.into_inner()))
    }

    fn refused(typed: &[&str]) -> String {
        let error = chosen(typed).unwrap_err();
        assert!(error.is::<Usage>(), "{error:#}");
        error.to_string()
    }

    #[test]
    fn what_makes_a_method_is_not_set_for_all() {
        let message = refused(&["--method", "sds", "-s", "light.guidance=lds"]);
        assert!(
            message.starts_with(
                "--set light.guidance=lds: the method \"sds\" sets light.guidance itself"
            ),
            "{message}"
        );
        let table = [
            "--method",
            "read",
            "-s",
            "light . learning_rates = { tone = 1 }",
        ];
        assert!(refused(&table).contains("sets light.learning_rates.radiance itself"));
        let map = ["--method", "neutral", "-s", "composite.environment=a.exr"];
        assert!(refused(&map).contains("the method \"neutral\" sets composite.environment itself"));
        let map = ["--method", "ours", "-s", "composite.environment=a.exr"];
        assert!(refused(&map).contains("the method \"ours\" sets composite.environment itself"));
        assert_eq!(
            refused(&["-s", "pipeline.seed=7"]),
            "--set pipeline.seed=7: every method has seed 0"
        );
        assert_eq!(
            refused(&["--method", "ours", "-s", "model.path=sd"]),
            "--set model.path=sd: use --model for that"
        );
        assert!(
            refused(&["-s", "composite.target_error=1"]).ends_with("use --target-error for that")
        );
        // Of other methods only, or of none.
        chosen(&["--method", "neutral", "-s", "light.guidance=lds"]).unwrap();
        chosen(&[
            "--method",
            "ours",
            "-s",
            "lora.steps=3",
            "-s",
            "light.adaptive=1",
        ])
        .unwrap();
    }

    #[test]
    fn what_changes_the_scenes_is_noted_because_the_truth_does_not_change() {
        let notes = |set: &str| chosen(&["--method", "neutral", "-s", set]).unwrap().1;
        let said = notes("scene.objects.0.height_m=2");
        assert_eq!(said.len(), 1);
        assert!(
            said[0].starts_with(
                "--set scene.objects.0.height_m=2: the true pictures show the scenes as they were made"
            ),
            "{said:?}"
        );
        assert_eq!(notes("scene . camera = { fov_deg = 50 }").len(), 1);
        for harmless in ["scene.class=car", "scene.effects.mode=all", "lora.steps=3"] {
            assert!(notes(harmless).is_empty(), "{harmless}");
        }
    }

    #[test]
    fn methods_that_read_light_are_left_out_where_the_model_does_not_know_it() {
        let folder = tempfile::tempdir().unwrap();
        let sd = folder.path().to_str().unwrap();
        let (named, notes) = chosen(&["--model", sd]).unwrap();
        assert!(
            named
                .iter()
                .any(|(n, m)| n == "ours" && m.as_deref() == Some(sd))
        );
        assert!(!named.iter().any(|(n, _)| n == "encoder" || n == "read"));
        let why = |name: &str| {
            format!(
                "the method \"{name}\" is left out: it needs a model that knows light, and {sd} has no \
                 light_encoder.safetensors"
            )
        };
        assert_eq!(notes, [why("encoder"), why("read")]);
        let message = refused(&["--model", sd, "--method", "read"]);
        assert_eq!(
            message,
            format!("no method is left to run: {}", why("read"))
        );
        fs::write(folder.path().join(encoder::FILE), "").unwrap();
        assert_eq!(
            chosen(&["--model", sd, "--method", "read"])
                .unwrap()
                .0
                .len(),
            1
        );
        let message = refused(&["--model", "nowhere", "--method", "ours"]);
        assert_eq!(
            message,
            "there is no model in nowhere; name a folder or a .safetensors file"
        );
    }

    #[test]
    fn a_row_s_own_model_comes_before_that_of_the_command_line() {
        let folder = tempfile::tempdir().unwrap();
        for (name, config) in [("small", "1"), ("large", "2")] {
            fs::create_dir_all(folder.path().join(name).join("unet")).unwrap();
            fs::write(folder.path().join(name).join("unet/config.json"), config).unwrap();
        }
        let row = |name: &str, model: &str| {
            format!(
                "[[method]]\nname = \"{name}\"\ntitle = \"\"\nlight = \"recovered\"\n\
                 stages = [\"scene\", \"light\"]\nset = ['model.path={model}', 'light.adapt=false']\nmodel = true\n"
            )
        };
        let file = folder.path().join("methods.toml");
        fs::write(&file, row("a", "small") + &row("b", "\"large\"")).unwrap();
        let small = folder.path().join("small");
        let (file, small) = (file.to_str().unwrap(), small.to_str().unwrap());
        let typed = [
            "--methods",
            file,
            "--method",
            "a",
            "--method",
            "b",
            "--method",
            "ours",
            "--model",
            small,
        ];
        let all = choose(&arguments(&typed), &|_| {}).unwrap();
        let of = |name: &str| all.iter().find(|c| c.method.name == name).unwrap();
        assert_eq!(of("a").digest(), of("ours").digest());
        assert_ne!(of("a").digest(), of("b").digest());
        let model = of("b").model.clone().unwrap();
        assert_eq!(model.used.path.as_deref(), Some("large"));
        assert_eq!(model.file, folder.path().join("large").canonicalize().ok());
        assert_eq!(of("b").method.set, ["light.adapt=false"]);
    }

    #[test]
    fn a_folder_of_maps_is_a_method_by_its_name() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["est", "neutral"] {
            fs::create_dir(folder.path().join(name)).unwrap();
        }
        let est = folder.path().join("est");
        let est = est.to_str().unwrap();
        let names = |typed: &[&str]| -> Vec<String> {
            chosen(typed)
                .unwrap()
                .0
                .into_iter()
                .map(|(n, _)| n)
                .collect()
        };
        assert_eq!(names(&["--environment-from", est]), ["est"]);
        assert_eq!(
            names(&["--environment-from", est, "--method", "est"]),
            ["est"]
        );
        let both = ["--environment-from", est, "--method", "neutral"];
        assert_eq!(names(&both), ["neutral", "est"]);
        let message = refused(&["--environment-from", est, "--method", "other"]);
        assert!(message.ends_with(", fitted, est"), "{message}");
        let neutral = folder.path().join("neutral");
        let message = refused(&["--environment-from", neutral.to_str().unwrap()]);
        assert!(
            message.contains("there is another method called \"neutral\""),
            "{message}"
        );
    }
}
