//! Tokens that were added to a tokenizer after its training, as textual inversion adds them: words with entries of their
//! own behind the vocabulary.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

use crate::config::ConfigFile;
use crate::error::Result;

/// The added tokens of a tokenizer's folder that `is_known` does not know, from `tokenizer.json` (`added_tokens`),
/// `added_tokens.json` and `tokenizer_config.json` (`added_tokens_decoder`).
pub(crate) fn read(
    folder: &Path,
    is_known: impl Fn(&str, u32) -> bool,
) -> Result<BTreeMap<String, u32>> {
    let mut added: BTreeMap<String, u32> = BTreeMap::new();
    for (name, tokens) in [
        ("tokenizer.json", of_list as fn(&ConfigFile) -> Pairs),
        ("added_tokens.json", of_map),
        ("tokenizer_config.json", of_decoder),
    ] {
        let path = folder.join(name);
        if !path.is_file() {
            continue;
        }
        let file = ConfigFile::read(&path)?;
        for (word, id) in tokens(&file) {
            let Some(id) = id.and_then(|id| u32::try_from(id).ok()) else {
                return Err(file.error(format!(
                    "the added token {word:?} has no whole number as id"
                )));
            };
            if word.is_empty() || is_known(&word, id) {
                continue;
            }
            let earlier = added.insert(word.clone(), id);
            if let Some(earlier) = earlier.filter(|&e| e != id) {
                return Err(file.error(format!(
                    "the added token {word:?} has the ids {earlier} and {id}; save the tokenizer again"
                )));
            }
        }
    }
    Ok(added)
}

/// Words and their ids.
type Pairs = Vec<(String, Option<u64>)>;

fn of_list(file: &ConfigFile) -> Pairs {
    let tokens = file.get("added_tokens").and_then(Value::as_array);
    let pair = |t: &Value| Some((t["content"].as_str()?.to_owned(), t["id"].as_u64()));
    tokens.into_iter().flatten().filter_map(pair).collect()
}

fn of_map(file: &ConfigFile) -> Pairs {
    let tokens = file.parse::<serde_json::Map<String, Value>>();
    let tokens = tokens.unwrap_or_default().into_iter();
    tokens.map(|(word, id)| (word, id.as_u64())).collect()
}

fn of_decoder(file: &ConfigFile) -> Pairs {
    let tokens = file.get("added_tokens_decoder").and_then(Value::as_object);
    let pair =
        |(id, t): (&String, &Value)| Some((t["content"].as_str()?.to_owned(), id.parse().ok()));
    tokens.into_iter().flatten().filter_map(pair).collect()
}

/// What each added word becomes: its token, and those of `word_1`, `word_2`... where they are there, as diffusers writes
/// an embedding of several vectors.
pub(crate) fn sequences(added: &BTreeMap<String, u32>) -> BTreeMap<String, Vec<u32>> {
    let sequence = |word: &str, first: u32| {
        let more = (1..).map_while(|n| added.get(&format!("{word}_{n}")).copied());
        std::iter::once(first).chain(more).collect()
    };
    let words = added.iter();
    words
        .map(|(word, &id)| (word.clone(), sequence(word, id)))
        .collect()
}
