//! Whether the result of an earlier stage is that of the keys and the model of now: a stage that is run alone takes what
//! is there.
use std::collections::BTreeSet;

use dipir_cli::session::Session;
use dipir_pipeline::fingerprint::{StaleReason, in_words, parameter_changes};
use dipir_pipeline::manifest::{Artifact, Manifest};
use dipir_pipeline::stage::StagePlan;

use crate::names::StageName;
use crate::reasons;
use crate::scene::unnumbered;

/// Warns if what `stage` left, which is called `what`, was made with other keys, by another model or of other files than
/// the run `now` would. Roles of files that `now` does not have are left out.
pub(crate) fn warn_of_other_settings(
    session: &Session,
    stage: &StageName,
    what: &str,
    now: &StagePlan,
) {
    // Whoever reads the results says that there are none.
    let Ok(was) = stage.manifest(session) else {
        return;
    };
    if let Some(words) = differences(stage.name, &was, now) {
        session.warn(&format!(
            "{what} made with other settings ({words}); run {} again to use those of now",
            stage.executable
        ));
    }
}

/// Keys of a table that say how a result is made, and show in no result.
const UNSEEN: [&str; 4] = ["recompute", "sheet_steps", "sample_every", "validate_every"];

/// What differs, in words.
fn differences(stage: &str, was: &Manifest, now: &StagePlan) -> Option<String> {
    let mut found = vec![];
    if was.seed != now.seed {
        found.push(StaleReason::Seed {
            was: was.seed,
            now: now.seed,
        });
    }
    found.extend(parameter_changes(&was.params, &now.params));
    found.retain(|reason| match reason {
        StaleReason::Parameter { key, .. } => {
            !UNSEEN.iter().any(|k| key.ends_with(&format!(".{k}")))
        }
        _ => true,
    });
    reasons::by_keys(stage, &mut found);
    let mut words = vec![];
    if !found.is_empty() {
        words.push(in_words(&found));
    }
    let roles: BTreeSet<&str> = now.inputs.iter().map(|i| unnumbered(&i.role)).collect();
    for role in roles {
        if hashes(&was.inputs, role) != hashes(&now.inputs, role) {
            words.push(format!("another {role}"));
        }
    }
    (!words.is_empty()).then(|| words.join("; "))
}

/// Hashes of all files of a role, whatever their numbers.
pub(crate) fn hashes<'a>(files: &'a [Artifact], role: &str) -> BTreeSet<&'a str> {
    let of_role = files.iter().filter(|f| unnumbered(&f.role) == role);
    of_role.map(|f| f.blake3.as_str()).collect()
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use serde_json::{Value, json};

    use super::*;
    use crate::names::{CONCEPTS, LORA};

    fn plan(params: Value, model: &[u8]) -> StagePlan {
        let mut plan = StagePlan::new("any", 1, params, 7);
        plan.input_of_bytes("model", Path::new("model_index.json"), b"{}");
        plan.input_of_bytes("model", Path::new("unet/config.json"), model);
        plan
    }

    fn manifest(plan: &StagePlan) -> Manifest {
        Manifest {
            schema: 2,
            stage: plan.stage.clone(),
            version: plan.version,
            params: plan.params.clone(),
            seed: plan.seed,
            device: plan.device.clone(),
            inputs: plan.inputs.clone(),
            outputs: vec![],
            elapsed_s: 1.0,
            timings_s: Default::default(),
            peak_rss_bytes: None,
            estimated_error: None,
        }
    }

    #[test]
    fn other_keys_another_seed_and_another_model_are_told() {
        let params = |class: &str| json!({"class": class, "concepts": {"count": 2}});
        let now = plan(params("car"), b"a");
        let told = |was: &StagePlan| differences(CONCEPTS.name, &manifest(was), &now);
        assert_eq!(told(&now), None);
        let class = told(&plan(params("cup"), b"a"));
        let wanted = "scene.class changed from \"cup\" to \"car\"";
        assert_eq!(class.as_deref(), Some(wanted));
        let mut unseen = params("car");
        unseen["lora"] = json!({"recompute": true});
        assert_eq!(told(&plan(unseen, b"a")), None);
        let model = told(&plan(params("car"), b"b"));
        assert_eq!(model.as_deref(), Some("another model"));
        let seed = told(&StagePlan {
            seed: 8,
            ..now.clone()
        });
        assert_eq!(seed.as_deref(), Some("the seed changed from 8 to 7"));
    }

    #[test]
    fn files_that_are_not_looked_at_make_no_difference() {
        let now = plan(json!({}), b"a");
        let mut was = now.clone();
        was.input_of_bytes("latents", Path::new("concepts/latents.safetensors"), b"x");
        assert_eq!(differences(LORA.name, &manifest(&was), &now), None);
    }
}
