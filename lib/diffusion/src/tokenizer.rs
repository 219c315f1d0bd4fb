//! CLIP's tokenizer: byte-level pair encoding of lower-cased words, read
//! from the files that a model folder carries.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::Value;
use tokenizers::models::bpe::{BPE, Merges, Vocab};
use tokenizers::normalizers::{
    Lowercase, NFC, Replace, Sequence as NormalizerSequence, replace::ReplacePattern,
};
use tokenizers::pre_tokenizers::byte_level::ByteLevel;
use tokenizers::pre_tokenizers::sequence::Sequence as PreTokenizerSequence;
use tokenizers::pre_tokenizers::split::{Split, SplitPattern};
use tokenizers::{
    NormalizerWrapper, PreTokenizerWrapper, SplitDelimiterBehavior, TokenizerBuilder,
};

use crate::added_tokens;
use crate::config::ConfigFile;
use crate::error::{Error, Result, io};

/// Words of CLIP: the markers, English contractions, runs of letters, single
/// digits, runs of anything else that is no space.
const WORDS: &str =
    r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+";
const START: &str = "<|startoftext|>";
const END: &str = "<|endoftext|>";
/// Sequence length of every published CLIP, both markers included.
const DEFAULT_LENGTH: usize = 77;

/// CLIP's merges, by which every published Stable Diffusion 1 and 2 splits words.
const CLIP_MERGES: &str = include_str!("../data/clip_merges.txt");

/// What fills a sequence behind its end marker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Padding {
    /// More end markers, as CLIP does.
    End,
    /// Token 0, as OpenCLIP does.
    First,
}

type Inner = tokenizers::TokenizerImpl<
    BPE,
    NormalizerSequence,
    PreTokenizerSequence,
    tokenizers::PostProcessorWrapper,
    tokenizers::DecoderWrapper,
>;

/// Text to token sequences of one fixed length.
pub struct Tokenizer {
    inner: Inner,
    path: PathBuf,
    start: u32,
    end: u32,
    pad: u32,
    length: usize,
    vocab_size: usize,
    /// Words of their own, in lower case, and the tokens that each becomes.
    placeholders: BTreeMap<String, Vec<u32>>,
}

impl std::fmt::Debug for Tokenizer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Tokenizer")
            .field("path", &self.path)
            .field("vocab_size", &self.vocab_size)
            .finish()
    }
}

impl Tokenizer {
    /// Loads the folder `tokenizer/` of a model: `vocab.json` with
    /// `merges.txt`, or else `tokenizer.json`. Added tokens are words of their
    /// own.
    pub fn load(folder: &Path) -> Result<Self> {
        let (vocab, merges) = if folder.join("vocab.json").is_file() {
            read_vocab_and_merges(folder)?
        } else {
            read_tokenizer_json(&folder.join("tokenizer.json"))?
        };
        let fail = |message: String| Error::Tokenizer {
            path: folder.to_owned(),
            message,
        };
        let is_known = |word: &str, id: u32| vocab.get(word) == Some(&id);
        let added = added_tokens::read(folder, is_known)?;
        let id = |token: &str| {
            let found = vocab.get(token).or_else(|| added.get(token));
            found
                .copied()
                .ok_or_else(|| fail(format!("the vocabulary lacks the marker {token}")))
        };
        let (start, end) = (id(START)?, id(END)?);
        let pad = match special(folder, "pad_token")? {
            Some(token) => id(&token)?,
            None => end,
        };
        let length = model_max_length(folder)?.unwrap_or(DEFAULT_LENGTH);
        if length < 2 {
            return Err(fail(format!(
                "model_max_length = {length} has no room for both markers"
            )));
        }
        let ids = vocab.values().chain(added.values());
        let vocab_size = ids.copied().max().unwrap_or(0) as usize + 1;
        let inner = build(vocab, merges).map_err(|e| fail(e.to_string()))?;
        let mut tokenizer = Self {
            inner,
            path: folder.to_owned(),
            start,
            end,
            pad,
            length,
            vocab_size,
            placeholders: BTreeMap::new(),
        };
        tokenizer.set_markers_apart();
        for (word, tokens) in added_tokens::sequences(&added) {
            tokenizer.set_apart(&word, tokens);
        }
        Ok(tokenizer)
    }

    /// CLIP's own tokenizer, for models that come without one.
    pub fn clip(padding: Padding) -> Result<Self> {
        let path = PathBuf::from("the built-in tokenizer");
        let merges = read_merges(&path, CLIP_MERGES)?;
        let vocab = vocab_of(&merges);
        let vocab_size = vocab.len();
        let (start, end) = (vocab_size as u32 - 2, vocab_size as u32 - 1);
        let inner = build(vocab, merges).map_err(|e| Error::Tokenizer {
            path: path.clone(),
            message: e.to_string(),
        })?;
        let mut tokenizer = Self {
            inner,
            path,
            start,
            end,
            pad: match padding {
                Padding::End => end,
                Padding::First => 0,
            },
            length: DEFAULT_LENGTH,
            vocab_size,
            placeholders: BTreeMap::new(),
        };
        tokenizer.set_markers_apart();
        Ok(tokenizer)
    }

    /// Markers that stand in a text are markers, as in CLIP.
    fn set_markers_apart(&mut self) {
        self.set_apart(START, vec![self.start]);
        self.set_apart(END, vec![self.end]);
    }

    /// Largest token + 1.
    pub fn vocab_size(&self) -> usize {
        self.vocab_size
    }

    /// Length of every sequence.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Shortens every sequence to at most `length` tokens, at least 2.
    pub fn limit_length(&mut self, length: usize) {
        self.length = self.length.min(length.max(2));
    }

    /// Makes the word `word` one token of its own, e.g. one whose embedding
    /// is learned. It may hold punctuation, as `<sks>`; words are compared in
    /// lower case, and an empty one is nowhere.
    pub fn add_placeholder(&mut self, word: &str, token: u32) {
        self.set_apart(word, vec![token]);
    }

    fn set_apart(&mut self, word: &str, tokens: Vec<u32>) {
        let word = word.chars().flat_map(char::to_lowercase).collect();
        self.placeholders.insert(word, tokens);
    }

    /// Tokens of `text` without markers, not cut.
    pub fn words(&self, text: &str) -> Result<Vec<u32>> {
        let fail = |e: tokenizers::Error| Error::Tokenizer {
            path: self.path.clone(),
            message: e.to_string(),
        };
        let encode = |text: &str| -> Result<Vec<u32>> {
            Ok(self
                .inner
                .encode(text, false)
                .map_err(fail)?
                .get_ids()
                .to_vec())
        };
        let (mut tokens, mut from, mut at) = (vec![], 0, 0);
        while let Some(next) = text[at..].chars().next() {
            match self.placeholder_at(text, at) {
                Some((length, own)) => {
                    tokens.extend(encode(&text[from..at])?);
                    tokens.extend(own);
                    at += length;
                    from = at;
                }
                None => at += next.len_utf8(),
            }
        }
        tokens.extend(encode(&text[from..])?);
        Ok(tokens)
    }

    /// The longest placeholder that stands at byte `at` of `text`: its length there, and its tokens.
    fn placeholder_at(&self, text: &str, at: usize) -> Option<(usize, &[u32])> {
        let (before, rest) = text.split_at(at);
        let found = self.placeholders.iter().filter_map(|(word, tokens)| {
            let length = length_in(rest, word)?;
            let is_apart = !continues(before.chars().next_back(), word.chars().next())
                && !continues(word.chars().next_back(), rest[length..].chars().next());
            is_apart.then_some((length, tokens.as_slice()))
        });
        found.max_by_key(|(length, _)| *length)
    }

    /// Start marker, the text cut to fit, end marker, padding: always
    /// [`Tokenizer::length`] tokens.
    pub fn encode(&self, text: &str) -> Result<Vec<u32>> {
        let mut tokens = vec![self.start];
        tokens.extend(self.words(text)?.into_iter().take(self.length - 2));
        tokens.push(self.end);
        tokens.resize(self.length, self.pad);
        Ok(tokens)
    }
}

/// Bytes of `text` that are the lower-case `word` at its start.
fn length_in(text: &str, word: &str) -> Option<usize> {
    let (mut wanted, mut length) = (word, 0);
    for c in text.chars() {
        if wanted.is_empty() {
            break;
        }
        for lower in c.to_lowercase() {
            wanted = wanted.strip_prefix(lower)?;
        }
        length += c.len_utf8();
    }
    (length > 0 && wanted.is_empty()).then_some(length)
}

/// Whether one word goes on from the character `left` to `right`.
fn continues(left: Option<char>, right: Option<char>) -> bool {
    let is_of_a_word = |c: Option<char>| c.is_some_and(char::is_alphanumeric);
    is_of_a_word(left) && is_of_a_word(right)
}

fn build(vocab: Vocab, merges: Merges) -> tokenizers::Result<Inner> {
    let model = BPE::builder()
        .vocab_and_merges(vocab, merges)
        .unk_token(END.into())
        .end_of_word_suffix("</w>".into())
        .build()?;
    let spaces = Replace::new(ReplacePattern::Regex(r"\s+".into()), " ")?;
    let normalizer = NormalizerSequence::new(vec![
        NormalizerWrapper::NFC(NFC),
        NormalizerWrapper::Replace(spaces),
        NormalizerWrapper::Lowercase(Lowercase),
    ]);
    let split = Split::new(
        SplitPattern::Regex(WORDS.into()),
        SplitDelimiterBehavior::Removed,
        true,
    )?;
    // The words are already split: its own pattern would split them again.
    let bytes = ByteLevel::new(false, true, true);
    let pre_tokenizer = PreTokenizerSequence::new(vec![
        PreTokenizerWrapper::Split(split),
        PreTokenizerWrapper::ByteLevel(bytes),
    ]);
    TokenizerBuilder::new()
        .with_model(model)
        .with_normalizer(Some(normalizer))
        .with_pre_tokenizer(Some(pre_tokenizer))
        .with_post_processor(None)
        .with_decoder(None)
        .build()
}

fn read_vocab_and_merges(folder: &Path) -> Result<(Vocab, Merges)> {
    let file = ConfigFile::read(&folder.join("vocab.json"))?;
    let vocab: Vocab = file.parse()?;
    let path = folder.join("merges.txt");
    let text = dipir_files::read_to_string(&path).map_err(io("read", &path))?;
    let merges = read_merges(&path, &text)?;
    Ok((vocab, merges))
}

/// The vocabulary that merges mean: a character for every byte, the same at the end of a word, what each merge gives, and
/// both markers.
fn vocab_of(merges: &Merges) -> Vocab {
    // Printable bytes stand for themselves, and come first.
    let printable = |b: &u8| matches!(b, 33..=126 | 161..=172 | 174..=255);
    let (first, others): (Vec<u8>, Vec<u8>) = (0..=255u8).partition(printable);
    let stand_in = |i: u32| char::from_u32(256 + i).unwrap_or('\u{fffd}');
    let symbols: Vec<char> = first
        .into_iter()
        .map(char::from)
        .chain((0..others.len() as u32).map(stand_in))
        .collect();
    let single = symbols.iter().map(|c| c.to_string());
    let last = symbols.iter().map(|c| format!("{c}</w>"));
    let merged = merges.iter().map(|(a, b)| format!("{a}{b}"));
    let markers = [START, END].map(String::from);
    let words = single.chain(last).chain(merged).chain(markers);
    words.zip(0..).collect()
}

fn read_merges(path: &Path, text: &str) -> Result<Merges> {
    let mut merges = Merges::new();
    for (number, line) in text.lines().enumerate() {
        if line.starts_with("#version") || line.is_empty() {
            continue;
        }
        let mut parts = line.split(' ');
        match (parts.next(), parts.next(), parts.next()) {
            (Some(a), Some(b), None) => merges.push((a.into(), b.into())),
            _ => {
                let message = format!(
                    "line {}: {line:?} is not a pair of symbols with a space between",
                    number + 1
                );
                return Err(Error::Tokenizer {
                    path: path.to_owned(),
                    message,
                });
            }
        }
    }
    Ok(merges)
}

fn read_tokenizer_json(path: &Path) -> Result<(Vocab, Merges)> {
    let file = ConfigFile::read(path)?;
    let fail = |message: &str| {
        file.error(format!(
            "{message}; a CLIP tokenizer has model.vocab and model.merges"
        ))
    };
    let model = file.get("model").ok_or_else(|| fail("no model"))?;
    let vocab = model.get("vocab").ok_or_else(|| fail("no model.vocab"))?;
    let vocab: Vocab =
        serde_json::from_value(vocab.clone()).map_err(|e| fail(&format!("model.vocab: {e}")))?;
    let merges = model
        .get("merges")
        .and_then(Value::as_array)
        .ok_or_else(|| fail("no model.merges"))?;
    let pair = |merge: &Value| -> Option<(String, String)> {
        match merge {
            Value::String(text) => text.split_once(' ').map(|(a, b)| (a.into(), b.into())),
            Value::Array(pair) if pair.len() == 2 => {
                Some((pair[0].as_str()?.into(), pair[1].as_str()?.into()))
            }
            _ => None,
        }
    };
    let merges = merges
        .iter()
        .map(|merge| pair(merge).ok_or_else(|| fail(&format!("merge {merge} is not a pair"))))
        .collect::<Result<_>>()?;
    Ok((vocab, merges))
}

/// A special token from `special_tokens_map.json` or `tokenizer_config.json`:
/// a string, or an object with its `content`.
fn special(folder: &Path, key: &str) -> Result<Option<String>> {
    for name in ["special_tokens_map.json", "tokenizer_config.json"] {
        let path = folder.join(name);
        if !path.is_file() {
            continue;
        }
        let file = ConfigFile::read(&path)?;
        let value = file.get(key).map(|v| v.get("content").unwrap_or(v));
        if let Some(token) = value.and_then(Value::as_str) {
            return Ok(Some(token.to_owned()));
        }
    }
    Ok(None)
}

fn model_max_length(folder: &Path) -> Result<Option<usize>> {
    let path = folder.join("tokenizer_config.json");
    if !path.is_file() {
        return Ok(None);
    }
    let length = ConfigFile::read(&path)?
        .get("model_max_length")
        .and_then(Value::as_u64);
    // "No limit" is written as 10^30 by some exporters, which is no u64.
    Ok(length.filter(|&n| n <= 1 << 20).map(|n| n as usize))
}
