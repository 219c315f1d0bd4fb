//! Whether a stage has to run again, and why.
//!
//! | enters the fingerprint | does not |
//! |---|---|
//! | stage name and code version | crate version, executable |
//! | parameters, defaults filled in, in any order | comments and layout of the TOML |
//! | seed | number of threads, device |
//! | role and content hash of every input | modification times, absolute paths |
//!
//! Where a parameter is the path of an input, the input's role stands in for it: moving a file
//! does not change what is in it.
use std::fmt;
use std::path::{Path, PathBuf};

use serde::{Serialize, Serializer};
use serde_json::Value;

use crate::error::{Damage, StageError};
use crate::manifest::{Artifact, Manifest};
use crate::stage::{MISSING, StagePlan};

/// A hash of everything that decides a stage's outputs.
#[derive(Clone, Debug, PartialEq, Eq, Hash, Serialize)]
pub struct Fingerprint(String);

/// What a [`Fingerprint`] is taken of: parts of a planned run. What is not named is left out.
#[derive(Clone, Debug)]
pub struct Parts<'a> {
    of: &'a str,
    version: u32,
    seed: u64,
    params: Value,
    inputs: &'a [Artifact],
}

impl<'a> Parts<'a> {
    /// Version of the code.
    pub fn version(mut self, version: u32) -> Self {
        self.version = version;
        self
    }

    /// Seed of every random number.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Settings, instead of any named before.
    pub fn params(mut self, params: Value) -> Self {
        self.params = params;
        self
    }

    /// Files that are read.
    pub fn inputs(mut self, inputs: &'a [Artifact]) -> Self {
        self.inputs = inputs;
        self
    }

    /// The fingerprint of these parts.
    pub fn finish(self) -> Fingerprint {
        let mut hasher = blake3::Hasher::new();
        let mut put = |text: &str| {
            hasher.update(&(text.len() as u64).to_le_bytes());
            hasher.update(text.as_bytes());
        };
        put("fingerprint 1");
        put(self.of);
        put(&self.version.to_string());
        put(&self.seed.to_string());
        for (key, value) in flat(&self.params, self.inputs) {
            put(&key);
            put(&value);
        }
        put("inputs");
        for (role, hash) in by_role(self.inputs) {
            put(role);
            put(hash);
        }
        Fingerprint(hasher.finalize().to_hex().to_string())
    }
}

impl Fingerprint {
    /// Begins the fingerprint of `what`, a stage or a part of its work.
    pub fn of(what: &str) -> Parts<'_> {
        Parts {
            of: what,
            version: 0,
            seed: 0,
            params: Value::Null,
            inputs: &[],
        }
    }

    /// Begins with all parts of a planned run.
    pub fn of_plan(plan: &StagePlan) -> Parts<'_> {
        Self::of(&plan.stage)
            .version(plan.version)
            .seed(plan.seed)
            .params(plan.params.clone())
            .inputs(&plan.inputs)
    }

    /// Its first 16 digits, for names of folders.
    pub fn short(&self) -> &str {
        &self.0[..16]
    }

    /// 64 hexadecimal digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Why a stage has to run.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "reason", rename_all = "snake_case")]
pub enum StaleReason {
    /// It never ran here.
    NeverRun,
    /// Its `stage.json` cannot be read, so nothing is known of its outputs.
    ManifestDamaged {
        /// The file.
        #[serde(serialize_with = "lossy")]
        path: PathBuf,
        /// Why not.
        message: String,
    },
    /// The stage's code is newer.
    Version {
        /// Version that made the outputs.
        was: u32,
        /// Version at hand.
        now: u32,
    },
    /// Another seed.
    Seed {
        /// Seed of the outputs.
        was: u64,
        /// Seed asked for.
        now: u64,
    },
    /// A parameter differs; `None` means absent.
    Parameter {
        /// Dotted key.
        key: String,
        /// JSON text of the outputs' value.
        was: Option<String>,
        /// JSON text of the value asked for.
        now: Option<String>,
    },
    /// An input has other bytes.
    InputChanged {
        /// Its role.
        role: String,
        /// Where it is.
        #[serde(serialize_with = "lossy")]
        path: PathBuf,
    },
    /// An input that was not there before.
    InputAdded {
        /// Its role.
        role: String,
    },
    /// An input that is no longer read.
    InputRemoved {
        /// Its role.
        role: String,
    },
    /// An output is not as it was written.
    OutputDamaged {
        /// The file.
        #[serde(serialize_with = "lossy")]
        path: PathBuf,
        /// How it differs.
        damage: Damage,
    },
}

/// A path as text, what is not UTF-8 in it replaced by U+FFFD.
fn lossy<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}

/// A value as it was written: a number of 32 bits without the digits that it got in 64.
fn short(value: &str) -> String {
    match value.parse::<f64>() {
        Ok(v) if value.contains('.') && f64::from(v as f32) == v => format!("{:?}", v as f32),
        _ => value.to_string(),
    }
}

impl fmt::Display for StaleReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let shown = |v: &Option<String>| match v.as_deref() {
            None | Some("null") => "unset".into(),
            Some(role) if role.starts_with('<') => "a file".into(),
            Some(value) => short(value),
        };
        match self {
            Self::NeverRun => write!(f, "it has not run yet"),
            Self::ManifestDamaged { path, message } => write!(f, "{}: {message}", path.display()),
            Self::Version { was, now } => {
                write!(f, "its code changed from version {was} to {now}")
            }
            Self::Seed { was, now } => write!(f, "the seed changed from {was} to {now}"),
            Self::Parameter { key, was, now } => match [shown(was), shown(now)] {
                [was, now] if was == "a file" && now == was => {
                    write!(f, "{key} names another file")
                }
                [was, now] => write!(f, "{key} changed from {was} to {now}"),
            },
            Self::InputChanged { role, path } => {
                let path = path.display();
                match role.strip_prefix(MISSING) {
                    Some(role) => write!(f, "the {role} {path} is there now"),
                    None => write!(f, "the {role} {path} has other content"),
                }
            }
            Self::InputAdded { role } => write!(f, "it now reads the {role}"),
            Self::InputRemoved { role } => write!(f, "it no longer reads the {role}"),
            Self::OutputDamaged { path, damage } => write!(f, "{}: {damage}", path.display()),
        }
    }
}

/// The reasons in words. A reason that several files of one role share is named once.
pub fn in_words(reasons: &[StaleReason]) -> String {
    let mut words: Vec<String> = Vec::new();
    let mut told: Vec<(&str, &str)> = Vec::new();
    for reason in reasons {
        let Some((verb, role)) = reason.about_inputs() else {
            words.push(reason.to_string());
            continue;
        };
        let alike = |r: &&StaleReason| r.about_inputs() == Some((verb, role));
        match reasons.iter().filter(alike).count() {
            1 => words.push(reason.to_string()),
            _ if told.contains(&(verb, role)) => {}
            n => {
                told.push((verb, role));
                let first = match reason {
                    StaleReason::InputChanged { path, .. } => {
                        format!(", {} the first", path.display())
                    }
                    _ => String::new(),
                };
                words.push(format!("{n} files of the {role} {verb}{first}"));
            }
        }
    }
    words.join("; ")
}

impl StaleReason {
    /// What has happened to an input, and its role without its number.
    fn about_inputs(&self) -> Option<(&'static str, &str)> {
        let (verb, role) = match self {
            Self::InputChanged { role, .. } if role.starts_with(MISSING) => {
                ("are there now", &role[MISSING.len()..])
            }
            Self::InputChanged { role, .. } => ("have other content", role.as_str()),
            Self::InputAdded { role } => ("are read now", role.as_str()),
            Self::InputRemoved { role } => ("are no longer read", role.as_str()),
            _ => return None,
        };
        let is_number = |n: &str| n.bytes().all(|b| b.is_ascii_digit());
        let base = role.rsplit_once(' ').filter(|(_, n)| is_number(n));
        Some((verb, base.map_or(role, |(base, _)| base)))
    }
}

/// Every reason why the outputs in `folder` are not those of `plan`; none if they are.
pub fn stale_reasons(plan: &StagePlan, folder: &Path) -> Result<Vec<StaleReason>, StageError> {
    let manifest = match Manifest::read(folder, "") {
        Ok(m) if m.stage == plan.stage => m,
        Ok(_) | Err(StageError::NotRun { .. }) => return Ok(vec![StaleReason::NeverRun]),
        Err(StageError::Manifest { path, message }) => {
            return Ok(vec![StaleReason::ManifestDamaged { path, message }]);
        }
        Err(e) => return Err(e),
    };
    let mut reasons = Vec::new();
    if manifest.version != plan.version {
        reasons.push(StaleReason::Version {
            was: manifest.version,
            now: plan.version,
        });
    }
    if manifest.seed != plan.seed {
        reasons.push(StaleReason::Seed {
            was: manifest.seed,
            now: plan.seed,
        });
    }
    reasons.extend(changes(
        &flat(
            &(plan.comparable)(manifest.params.clone()),
            &manifest.inputs,
        ),
        &flat(&plan.params, &plan.inputs),
    ));
    reasons.extend(input_changes(&manifest.inputs, &plan.inputs));
    let damages = manifest.damages(folder)?;
    reasons.extend(
        damages
            .into_iter()
            .map(|(path, damage)| StaleReason::OutputDamaged { path, damage }),
    );
    Ok(reasons)
}

/// How the parameters `now` differ from what they `was`, paths included.
pub fn parameter_changes(was: &Value, now: &Value) -> Vec<StaleReason> {
    changes(&flat(was, &[]), &flat(now, &[]))
}

fn changes(was: &[(String, String)], now: &[(String, String)]) -> Vec<StaleReason> {
    let mut keys: Vec<&String> = was.iter().chain(now).map(|(key, _)| key).collect();
    keys.sort();
    keys.dedup();
    let find = |list: &[(String, String)], key: &str| {
        list.iter().find(|(k, _)| k == key).map(|(_, v)| v.clone())
    };
    keys.into_iter()
        .map(|key| (key, find(was, key), find(now, key)))
        .filter(|(_, was, now)| was != now)
        .map(|(key, was, now)| StaleReason::Parameter {
            key: key.clone(),
            was,
            now,
        })
        .collect()
}

fn input_changes(was: &[Artifact], now: &[Artifact]) -> Vec<StaleReason> {
    let mut reasons = Vec::new();
    for input in now {
        match was.iter().find(|a| a.role == input.role) {
            None => reasons.push(StaleReason::InputAdded {
                role: input.role.clone(),
            }),
            Some(old) if old.blake3 != input.blake3 => reasons.push(StaleReason::InputChanged {
                role: input.role.clone(),
                path: input.path.clone(),
            }),
            Some(_) => {}
        }
    }
    for old in was {
        if !now.iter().any(|a| a.role == old.role) {
            reasons.push(StaleReason::InputRemoved {
                role: old.role.clone(),
            });
        }
    }
    reasons
}

fn by_role(inputs: &[Artifact]) -> Vec<(&str, &str)> {
    let mut pairs: Vec<_> = inputs
        .iter()
        .map(|a| (a.role.as_str(), a.blake3.as_str()))
        .collect();
    pairs.sort_unstable();
    pairs
}

/// Every leaf of `params` as (dotted key, JSON text), sorted by key.
fn flat(params: &Value, inputs: &[Artifact]) -> Vec<(String, String)> {
    let mut leaves = Vec::new();
    collect(params, String::new(), inputs, &mut leaves);
    leaves.sort();
    leaves
}

fn collect(value: &Value, key: String, inputs: &[Artifact], leaves: &mut Vec<(String, String)>) {
    let below = |step: &str| match key.is_empty() {
        true => step.to_string(),
        false => format!("{key}.{step}"),
    };
    match value {
        Value::Object(members) if !members.is_empty() => {
            for (name, member) in members {
                collect(member, below(name), inputs, leaves);
            }
        }
        Value::Array(items) if !items.is_empty() => {
            for (i, item) in items.iter().enumerate() {
                collect(item, below(&i.to_string()), inputs, leaves);
            }
        }
        Value::String(text) => {
            let input = inputs.iter().find(|a| a.path == Path::new(text));
            let text = match input {
                Some(input) => format!("<{}>", input.role),
                None => value.to_string(),
            };
            leaves.push((key, text));
        }
        leaf => leaves.push((key, leaf.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use serde_json::json;

    use super::*;
    use crate::lock::WhenLocked;
    use crate::stage::StageWriter;

    fn plan(folder: &Path) -> StagePlan {
        let background = folder.join("background.png");
        if !background.exists() {
            fs::write(&background, "pixels").unwrap();
        }
        let params = json!({
            "background": background,
            "class": "car",
            "position": [0.0, 1.0, 2.0],
        });
        let mut plan = StagePlan::new("scene", 1, params, 0);
        plan.input("background", &background, &background).unwrap();
        plan
    }

    fn run(plan: &StagePlan, target: &Path) {
        let mut writer = StageWriter::begin(target, plan.clone(), WhenLocked::Refuse).unwrap();
        fs::write(writer.output("image", "a.png").unwrap(), "a").unwrap();
        writer.finish().unwrap();
    }

    fn reasons(plan: &StagePlan, target: &Path) -> Vec<String> {
        let reasons = stale_reasons(plan, target).unwrap();
        let manifest = Manifest::read(target, "").unwrap();
        let was = Fingerprint::of(&manifest.stage)
            .version(manifest.version)
            .seed(manifest.seed)
            .params(manifest.params.clone())
            .inputs(&manifest.inputs);
        let same = was.finish() == Fingerprint::of_plan(plan).finish();
        let only_outputs = reasons
            .iter()
            .all(|r| matches!(r, StaleReason::OutputDamaged { .. }));
        assert_eq!(same, only_outputs, "fingerprints and reasons must agree");
        reasons.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn a_stage_that_ran_with_the_same_plan_is_fresh() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("scene");
        let plan = plan(dir.path());
        assert_eq!(
            stale_reasons(&plan, &target).unwrap(),
            [StaleReason::NeverRun]
        );
        run(&plan, &target);
        assert!(reasons(&plan, &target).is_empty());
    }

    #[test]
    fn every_kind_of_change_is_named_in_words() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("scene");
        let first = plan(dir.path());
        run(&first, &target);

        let mut changed = first.clone();
        changed.seed = 5;
        assert_eq!(reasons(&changed, &target), ["the seed changed from 0 to 5"]);

        let mut changed = first.clone();
        changed.version = 2;
        assert_eq!(
            reasons(&changed, &target),
            ["its code changed from version 1 to 2"]
        );

        let mut changed = first.clone();
        changed.params["class"] = json!("chair");
        changed.params["position"][1] = json!(0.02f32);
        changed.params["extra"] = json!(true);
        assert_eq!(
            reasons(&changed, &target),
            [
                "class changed from \"car\" to \"chair\"",
                "extra changed from unset to true",
                "position.1 changed from 1.0 to 0.02",
            ]
        );

        fs::write(dir.path().join("background.png"), "other").unwrap();
        let path = dir.path().join("background.png");
        assert_eq!(
            reasons(&plan(dir.path()), &target),
            [format!(
                "the background {} has other content",
                path.display()
            )]
        );
    }

    #[test]
    fn a_changed_model_is_told_in_one_phrase() {
        let changed = |role: &str, path: &str| StaleReason::InputChanged {
            role: role.into(),
            path: path.into(),
        };
        let reasons = [
            StaleReason::Seed { was: 0, now: 1 },
            changed("model", "sd/unet/config.json"),
            changed("model 2", "sd/vae/config.json"),
            changed("photo", "a.png"),
            changed("model 12", "sd/x"),
        ];
        assert_eq!(
            in_words(&reasons),
            "the seed changed from 0 to 1; 3 files of the model have other content, \
             sd/unet/config.json the first; the photo a.png has other content"
        );
    }

    #[test]
    fn files_that_were_missing_are_told_once_they_are_there() {
        let came = |path: &str| StaleReason::InputChanged {
            role: format!("{MISSING}part of object"),
            path: path.into(),
        };
        let told = |paths: &[&str]| in_words(&paths.iter().map(|p| came(p)).collect::<Vec<_>>());
        assert_eq!(told(&["a"]), "the part of object a is there now");
        let both = "2 files of the part of object are there now, a the first";
        assert_eq!(told(&["a", "b"]), both);
    }

    #[test]
    fn moving_the_folder_or_touching_a_file_changes_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let here = dir.path().join("here");
        fs::create_dir(&here).unwrap();
        run(&plan(&here), &here.join("scene"));
        let there = dir.path().join("there");
        fs::rename(&here, &there).unwrap();
        fs::write(there.join("background.png"), "pixels").unwrap();
        assert!(reasons(&plan(&there), &there.join("scene")).is_empty());
    }

    #[test]
    fn the_order_of_parameters_does_not_matter() {
        let a = StagePlan::new("s", 1, json!({"a": 1, "b": {"c": 2, "d": 3}}), 0);
        let b = StagePlan::new("s", 1, json!({"b": {"d": 3, "c": 2}, "a": 1}), 0);
        let c = StagePlan::new("s", 1, json!({"b": {"d": 2, "c": 3}, "a": 1}), 0);
        let [a, b, c] = [a, b, c].map(|plan| Fingerprint::of_plan(&plan).finish());
        assert_eq!(a, b);
        assert_ne!(a, c);
    }

    #[test]
    fn the_device_does_not_show_and_every_other_part_does() {
        let mut plan = StagePlan::new("s", 1, json!({"a": 1}), 0);
        plan.input_of_bytes("photo", Path::new("a"), b"pixels");
        let of = |plan: &StagePlan| Fingerprint::of_plan(plan).finish();
        let first = of(&plan);
        plan.device = "cuda:0".into();
        assert_eq!(of(&plan), first);
        let parts = || Fingerprint::of_plan(&plan);
        let other = StagePlan::new("t", 1, json!({"a": 1}), 0);
        for changed in [
            parts().version(2),
            parts().seed(1),
            parts().params(json!({"a": 2})),
            parts().inputs(&[]),
            Fingerprint::of_plan(&other).inputs(&plan.inputs),
        ] {
            assert_ne!(changed.finish(), first);
        }
    }

    #[test]
    fn a_damaged_output_makes_its_stage_stale() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("scene");
        let plan = plan(dir.path());
        run(&plan, &target);
        fs::write(target.join("a.png"), "").unwrap();
        assert_eq!(
            reasons(&plan, &target),
            [format!(
                "{}: damaged: 0 bytes, but 1 were written",
                target.join("a.png").display()
            )]
        );
    }
}
