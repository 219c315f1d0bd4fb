//! Captions as the UNet takes them: states of the text encoder, in which weighted words are weighted embeddings.

use candle_core::{Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::text_encoder::{LearnedTokens, TextEncoder};
use dipir_diffusion::tokenizer::Tokenizer;

use crate::caption::{Caption, LightDescription, PLACEHOLDERS};
use crate::error::{Error, Result};

/// Registers the placeholders of [`Caption`] with a tokenizer.
pub fn add_placeholders(tokenizer: &mut Tokenizer) {
    let first = tokenizer.vocab_size() as u32;
    for (i, word) in PLACEHOLDERS.iter().enumerate() {
        tokenizer.add_placeholder(word, first + i as u32);
    }
}

/// Tokens of captions, and the embeddings of their placeholders.
pub struct EncodedCaptions {
    tokens: Vec<Vec<u32>>,
    /// Weights of all words for every placeholder of all captions, [placeholders, vocabulary].
    word_weights: Option<Tensor>,
}

impl EncodedCaptions {
    /// Encodes `captions`, `None` being the empty one. The tokenizer needs [`add_placeholders`]. Fails if a word of a
    /// mixture is not one token.
    pub fn new(tokenizer: &Tokenizer, captions: &[Option<Caption>]) -> Result<Self> {
        let vocab = tokenizer.vocab_size();
        let mut rows: Vec<f32> = vec![];
        let mut tokens = vec![];
        for caption in captions {
            let Some(caption) = caption else {
                tokens.push(tokenizer.encode("")?);
                continue;
            };
            let shift = (rows.len() / vocab) as u32;
            for mixture in &caption.mixtures {
                let start = rows.len();
                rows.resize(start + vocab, 0.0);
                for (word, weight) in mixture {
                    let ids = tokenizer.words(word)?;
                    let [id] = ids[..] else {
                        return Err(Error::Argument(format!(
                            "the model's tokenizer has no token for {word:?}, which describes light; use the model of \
                             data/prior or one that dipir-pretrain trained"
                        )));
                    };
                    rows[start + id as usize] += weight;
                }
            }
            let ids = tokenizer.encode(&caption.text)?;
            let moved = ids
                .iter()
                .map(|&t| if t as usize >= vocab { t + shift } else { t });
            tokens.push(moved.collect());
        }
        let count = rows.len() / vocab;
        let word_weights = (count > 0)
            .then(|| Tensor::from_vec(rows, (count, vocab), &Device::Cpu))
            .transpose()?;
        Ok(Self {
            tokens,
            word_weights,
        })
    }

    /// States [captions, tokens, width].
    pub fn states(&self, text: &TextEncoder) -> Result<Tensor> {
        let learned = match &self.word_weights {
            Some(weights) => Some(LearnedTokens {
                embeddings: weights.matmul(text.table())?,
            }),
            None => None,
        };
        Ok(text.forward(&self.tokens, learned.as_ref())?)
    }
}

/// States of captions under `model`, [captions, tokens, width].
pub fn caption_states(model: &Model, captions: &[Option<Caption>]) -> Result<Tensor> {
    EncodedCaptions::new(&model.tokenizer, captions)?.states(&model.text_encoder)
}

/// States for guidance towards `light`: of the caption that describes it first, then of those whose mean prediction is
/// subtracted. These are its [`LightDescription::quarter_turns`], or the empty caption where there is no sun to turn.
pub fn guidance_states(model: &Model, class: &str, light: &LightDescription) -> Result<Tensor> {
    let caption = |light: &LightDescription| Some(Caption::new(class, Some(light)));
    let captions: Vec<_> = match light.is_overcast() {
        true => vec![caption(light), None],
        false => std::iter::once(caption(light))
            .chain(light.quarter_turns().iter().map(caption))
            .collect(),
    };
    caption_states(model, &captions)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn every_placeholder_of_every_caption_is_a_token_of_its_own() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/prior/tokenizer");
        let mut tokenizer = Tokenizer::load(&folder).unwrap();
        add_placeholders(&mut tokenizer);
        let light = |azimuth: f32| LightDescription {
            azimuth,
            elevation: 0.5,
            sun_share: 0.8,
        };
        let caption = |azimuth: f32| Some(Caption::new("red car", Some(&light(azimuth))));
        let encoded =
            EncodedCaptions::new(&tokenizer, &[caption(0.1), None, caption(2.0)]).unwrap();
        let vocab = tokenizer.vocab_size() as u32;
        let tokens = encoded.tokens.iter().flatten();
        let placeholders: Vec<u32> = tokens.copied().filter(|t| *t >= vocab).collect();
        assert_eq!(placeholders, [0, 1, 2, 3, 4, 5].map(|i| vocab + i));
        // The weights of each sum to 1.
        let sums = encoded.word_weights.unwrap().sum(1).unwrap();
        let sums = sums.to_vec1::<f32>().unwrap();
        assert_eq!(sums.len(), 6);
        assert!(sums.iter().all(|s| (s - 1.0).abs() < 1e-6), "{sums:?}");
    }

    #[test]
    fn a_word_without_a_token_is_refused_with_a_remedy() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data/prior/tokenizer");
        let mut tokenizer = Tokenizer::load(&folder).unwrap();
        add_placeholders(&mut tokenizer);
        let caption = Caption {
            text: "mixeda".into(),
            mixtures: vec![vec![("zebra", 1.0)]],
        };
        let refused = EncodedCaptions::new(&tokenizer, &[Some(caption)]);
        let error = refused.err().unwrap().to_string();
        assert!(
            error.contains("\"zebra\"") && error.contains("data/prior"),
            "{error}"
        );
    }
}
