//! What the LoRA stage leaves, for the light stage.
use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use dipir_cli::session::Session;
use dipir_diffusion::lora::Lora;
use dipir_diffusion::model::Model;
use dipir_diffusion::text_encoder::LearnedTokens;
use dipir_diffusion::weights::Weights;
use dipir_guidance::distillation::Adapter;
use dipir_pipeline::manifest::Manifest;
use dipir_pipeline::stage::StagePlan;

use crate::lora::table::LoraTable;
use crate::names::LORA;

/// Whether the run learned an embedding for its word.
fn has_word(manifest: &Manifest) -> bool {
    manifest.outputs.iter().any(|o| o.role == "word")
}

/// Adds what the LoRA stage wrote to the plan of a stage that uses it.
pub fn add_inputs(session: &Session, plan: &mut StagePlan) -> anyhow::Result<()> {
    let manifest = LORA.manifest(session)?;
    let roles: &[&str] = match has_word(&manifest) {
        true => &["lora", "word"],
        false => &["lora"],
    };
    Ok(plan.outputs_of(&manifest, roles)?)
}

/// Reads what the LoRA stage wrote; a word that it learned becomes a token of the model.
pub fn read(session: &Session, model: &mut Model) -> anyhow::Result<Adapter> {
    let table: LoraTable = session.config.table("lora")?;
    let (folder, manifest) = (LORA.folder(session), LORA.manifest(session)?);
    let targets = model.unet.adapter_targets();
    let path = manifest.output(&folder, "lora")?;
    let lora = Lora::load(&path, &targets, model.dtype(), model.device())?;
    let learned = match has_word(&manifest) {
        true => {
            let path = manifest.output(&folder, "word")?;
            Some(learned_word(model, &table.word, &path)?)
        }
        false => None,
    };
    Ok(Adapter {
        lora: Arc::new(lora),
        learned,
        word: table.word,
    })
}

/// The embedding that a run learned for `word`; the word becomes a token of its own.
fn learned_word(model: &mut Model, word: &str, path: &Path) -> anyhow::Result<LearnedTokens> {
    let weights = Weights::open_file(path)?;
    let embeddings = weights
        .tensor(word, model.dtype(), model.device())?
        .with_context(|| {
            format!(
                "{} holds no embedding of lora.word = \"{word}\"; run {} again",
                path.display(),
                LORA.executable
            )
        })?;
    let token = model.text_encoder.config().vocab_size as u32;
    model.tokenizer.add_placeholder(word, token);
    Ok(LearnedTokens { embeddings })
}
