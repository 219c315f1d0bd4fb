//! What a score was made with: scores that were not made alike are neither summed up nor compared.
use std::collections::{BTreeMap, BTreeSet};

use dipir_stages::names;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::methods::{Method, key_of};

/// A diffusion model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UsedModel {
    /// Its path as it was given; absent for the embedded one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub path: Option<String>,
    /// Hash of its files.
    pub digest: String,
}

impl UsedModel {
    fn in_words(&self) -> String {
        let short = self.digest.get(..8).unwrap_or(&self.digest);
        match &self.path {
            Some(path) => format!("the model {path} ({short})"),
            None => format!("the embedded model ({short})"),
        }
    }
}

/// What decides a score beside the scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Definition {
    /// The method's row, without the path of its model.
    pub row: Method,
    /// The diffusion model, if one is asked.
    pub model: Option<UsedModel>,
    /// What `run --set` sets: keys and values.
    pub set: BTreeMap<String, String>,
    /// Display-referred RMSE of the composite.
    pub target_error: f64,
    /// Versions of the stages that run.
    pub stages: BTreeMap<String, u32>,
}

impl Definition {
    /// A row with its model, under the options of a run.
    pub fn new(row: &Method, model: Option<UsedModel>, set: &[String], target_error: f64) -> Self {
        let runs =
            |name: &str| name == names::COMPOSITE.name || row.stages.iter().any(|s| s == name);
        let stages = names::ALL.iter().filter(|s| runs(s.name));
        let value = |set: &String| {
            let value = set.split_once('=').map_or("", |(_, value)| value);
            (key_of(set), value.trim().to_owned())
        };
        Self {
            row: row.clone(),
            model,
            set: set.iter().map(value).collect(),
            target_error,
            stages: stages.map(|s| (s.name.to_owned(), s.version)).collect(),
        }
    }

    /// What differs between two definitions of one method: of each in words.
    pub fn unlike(&self, other: &Self) -> Option<[String; 2]> {
        self.unlike_rows(other)
            .or_else(|| self.unlike_options(other, |_| true))
    }

    /// What differs between what two methods should share, of each in words: the model, and the settings and versions
    /// of the stages that both run.
    pub fn unlike_shared(&self, other: &Self) -> Option<[String; 2]> {
        let both = [self, other];
        self.unlike_options(other, |table| match table {
            "model" => both.iter().all(|d| d.model.is_some()),
            _ if names::ALL.iter().any(|s| s.name == table) => {
                both.iter().all(|d| d.stages.contains_key(table))
            }
            _ => true,
        })
    }

    fn unlike_rows(&self, other: &Self) -> Option<[String; 2]> {
        let rows = [self, other].map(|d| serde_json::to_value(&d.row).unwrap_or(Value::Null));
        let fields = rows[0].as_object()?;
        let (field, _) = fields.iter().find(|(k, v)| rows[1].get(k) != Some(v))?;
        Some([0, 1].map(|k| format!("the row's {field} = {}", rows[k][field])))
    }

    /// What differs, as far as it is about the tables of `pipeline.toml` that count.
    fn unlike_options(&self, other: &Self, counts: impl Fn(&str) -> bool) -> Option<[String; 2]> {
        if let (Some(a), Some(b)) = (&self.model, &other.model)
            && a.digest != b.digest
        {
            return Some([a.in_words(), b.in_words()]);
        }
        let keys: BTreeSet<&String> = self.set.keys().chain(other.set.keys()).collect();
        let is_unlike = |key: &&&String| {
            let table = key.split('.').next().unwrap_or_default();
            self.set.get(**key) != other.set.get(**key) && counts(table)
        };
        if let Some(key) = keys.iter().find(is_unlike) {
            let words = |d: &Self| match d.set.get(*key) {
                Some(value) => format!("--set {key}={value}"),
                None => format!("no --set {key}"),
            };
            return Some([words(self), words(other)]);
        }
        if self.target_error != other.target_error {
            return Some([self, other].map(|d| format!("--target-error {}", d.target_error)));
        }
        let both = self.stages.iter().filter_map(|(stage, a)| {
            let b = other.stages.get(stage)?;
            (a != b).then(|| [a, b].map(|v| format!("version {v} of the stage {stage}")))
        });
        both.into_iter().next()
    }

    /// The model in words.
    pub fn model_in_words(&self) -> String {
        let model = self.model.as_ref();
        model.map_or("no model".into(), UsedModel::in_words)
    }

    /// What `run --set` sets, as it is typed.
    pub fn set_in_words(&self) -> String {
        let pairs = self.set.iter().map(|(k, v)| format!("--set {k}={v}"));
        pairs.collect::<Vec<_>>().join(" ")
    }

    /// The model and the options of the run.
    pub fn in_words(&self) -> String {
        let error = format!("--target-error {}", self.target_error);
        let words = [self.model_in_words(), self.set_in_words(), error];
        let words: Vec<String> = words.into_iter().filter(|w| !w.is_empty()).collect();
        words.join(", ")
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::methods;

    /// The definition of a built-in method.
    pub(crate) fn of(name: &str, model: &str, set: &[&str]) -> Definition {
        let rows = methods::read(None).unwrap();
        let row = rows.iter().find(|m| m.name == name).unwrap();
        let model = row.model.then(|| UsedModel {
            path: (model != "embedded").then(|| model.into()),
            digest: format!("{model:0<16}"),
        });
        let set: Vec<String> = set.iter().map(|s| (*s).into()).collect();
        Definition::new(row, model, &set, 0.004)
    }

    #[test]
    fn one_method_is_defined_by_row_model_settings_and_versions() {
        let ours = of("ours", "embedded", &["lora.steps=200", "light.lobes=8"]);
        let turned = of("ours", "embedded", &["light.lobes=8", "lora.steps = 200"]);
        assert_eq!(ours.unlike(&turned), None);
        let words = |other: &Definition| ours.unlike(other).unwrap().join(" / ");
        assert_eq!(
            words(&of("ours", "sd", &[])),
            "the embedded model (embedded) / the model sd (sd000000)"
        );
        assert_eq!(
            words(&of("ours", "embedded", &["light.lobes=8"])),
            "--set lora.steps=200 / no --set lora.steps"
        );
        let mut other = ours.clone();
        other.row.set = vec!["light.guidance=sds".into()];
        assert_eq!(
            words(&other),
            "the row's set = [\"light.guidance=lds\"] / the row's set = [\"light.guidance=sds\"]"
        );
        let other = Definition {
            target_error: 0.1,
            ..ours.clone()
        };
        assert_eq!(words(&other), "--target-error 0.004 / --target-error 0.1");
        let mut other = ours.clone();
        other.stages.insert("light".into(), 0);
        assert!(words(&other).ends_with("/ version 0 of the stage light"));
    }

    #[test]
    fn two_methods_share_the_model_and_the_settings_of_stages_that_both_run() {
        let ours = of("ours", "embedded", &["lora.steps=200"]);
        // Neither of the two trains an adapter, and one asks no model.
        assert_eq!(of("read", "embedded", &[]).unlike_shared(&ours), None);
        assert_eq!(of("neutral", "embedded", &[]).unlike_shared(&ours), None);
        let read = of("read", "sd", &["lora.steps=200"]);
        assert!(read.unlike_shared(&ours).unwrap()[0].contains("the model sd"));
        let finer = of("read", "embedded", &["light.lobes=8"]);
        let words = ["--set light.lobes=8", "no --set light.lobes"].map(String::from);
        assert_eq!(finer.unlike_shared(&ours), Some(words));
        assert_eq!(
            of("neutral", "", &["light.lobes=8"]).unlike_shared(&ours),
            None
        );
    }

    #[test]
    fn words_say_the_model_and_the_options() {
        let words = of("ours", "sd", &["lora.steps=200"]).in_words();
        assert_eq!(
            words,
            "the model sd (sd000000), --set lora.steps=200, --target-error 0.004"
        );
        assert_eq!(
            of("neutral", "", &[]).in_words(),
            "no model, --target-error 0.004"
        );
    }
}
