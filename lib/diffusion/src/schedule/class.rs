//! What the scheduler's class says that a configuration names, by diffusers 0.42.1.

use serde_json::{Map, Value, json};

use crate::config::ConfigFile;

/// How diffusers' schedulers begin that interpolate to noise, or scale it without bound.
const FOREIGN_FAMILIES: [&str; 4] = ["FlowMatch", "FlowMap", "EDM", "Helios"];
/// Others whose noise is not of a schedule of betas, or not of it alone.
const FOREIGN_SCHEDULERS: [&str; 15] = [
    "AmusedScheduler",
    "CMStochasticIterativeScheduler",
    "CogVideoXDDIMScheduler",
    "CogVideoXDPMScheduler",
    "ConsistencyDecoderScheduler",
    "CosineDPMSolverMultistepScheduler",
    "DDPMWuerstchenScheduler",
    "IPNDMScheduler",
    "KarrasVeScheduler",
    "LTXEulerAncestralRFScheduler",
    "PiflowScheduler",
    "SCMScheduler",
    "ScoreSdeVeScheduler",
    "ScoreSdeVpScheduler",
    "VQDiffusionScheduler",
];

/// Keys of samplers that change what is sampled.
const SAMPLER_KEYS: [&str; 6] = [
    "use_karras_sigmas",
    "use_exponential_sigmas",
    "use_beta_sigmas",
    "use_flow_sigmas",
    "use_lu_lambdas",
    "thresholding",
];
/// Samplers of models that are made for a few steps of them.
const FEW_STEPS: [&str; 2] = ["LCMScheduler", "TCDScheduler"];

/// Whether the noise of `class` is not that of a schedule of betas.
pub(super) fn is_foreign(class: &str) -> bool {
    let mut families = FOREIGN_FAMILIES.iter();
    families.any(|start| class.starts_with(start)) || FOREIGN_SCHEDULERS.contains(&class)
}

/// Keys of the betas that `class` has other defaults for than most.
pub(super) fn betas(class: &str) -> Map<String, Value> {
    let mut keys = Map::new();
    let mut set = |key: &str, value| keys.insert(key.to_owned(), value);
    match class {
        "LCMScheduler" | "TCDScheduler" => {
            set("beta_start", json!(0.00085));
            set("beta_end", json!(0.012));
            set("beta_schedule", json!("scaled_linear"));
        }
        "DPMSolverSDEScheduler"
        | "HeunDiscreteScheduler"
        | "KDPM2AncestralDiscreteScheduler"
        | "KDPM2DiscreteScheduler" => {
            set("beta_start", json!(0.00085));
            set("beta_end", json!(0.012));
        }
        "UnCLIPScheduler" => {
            set("beta_schedule", json!("squaredcos_cap_v2"));
        }
        _ => {}
    }
    keys
}

/// Settings of the file that other samplers than ours heed.
pub(super) fn unused(file: &ConfigFile, class: &str) -> Vec<String> {
    let is_set = |key: &str| file.get(key).and_then(Value::as_bool) == Some(true);
    let few_steps = FEW_STEPS.contains(&class).then(|| class.to_owned());
    let keys = SAMPLER_KEYS.iter().filter(|key| is_set(key));
    // Others carry the key and do not heed it.
    let clips = class.starts_with("DDIM") || class.starts_with("DDPM");
    let clips = (clips && is_set("clip_sample")).then(|| "clip_sample".to_owned());
    let keys = keys.map(|key| (*key).to_owned());
    few_steps.into_iter().chain(keys).chain(clips).collect()
}
