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

    /// Tokens of every caption; those from the vocabulary's size on are placeholders.
    pub fn tokens(&self) -> &[Vec<u32>] {
        &self.tokens
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
