//! A tokenizer like that of CLIP for a small vocabulary: every listed word is one token, other words are split into
//! bytes.

use std::collections::HashMap;
use std::path::Path;

use serde_json::{Map, Value, json};

use crate::error::{Result, io};

const START: &str = "<|startoftext|>";
const END: &str = "<|endoftext|>";

/// The character that stands for each byte in byte-level pair encoding
/// [Radford et al. 2019]: itself where it prints, from U+0100 on elsewhere.
fn byte_characters() -> Vec<char> {
    let prints = |b: u32| matches!(b, 33..=126 | 161..=172 | 174..=255);
    let mut next = 256;
    (0..256u32)
        .map(|b| {
            let code = if prints(b) {
                b
            } else {
                next += 1;
                next - 1
            };
            char::from_u32(code).unwrap_or('?')
        })
        .collect()
}

/// Merges that make each of `words` one token.
fn merges_for(words: &[&str], characters: &[char]) -> Vec<(String, String)> {
    let mut merges: Vec<(String, String)> = vec![];
    let mut ranks: HashMap<(String, String), usize> = HashMap::new();
    for word in words {
        let mut pieces: Vec<String> = word
            .bytes()
            .map(|b| characters[b as usize].to_string())
            .collect();
        if let Some(last) = pieces.last_mut() {
            last.push_str("</w>");
        }
        while pieces.len() > 1 {
            let pair = |i: usize| (pieces[i].clone(), pieces[i + 1].clone());
            let best = (0..pieces.len() - 1)
                .filter_map(|i| ranks.get(&pair(i)).map(|rank| (*rank, i)))
                .min();
            let at = best.map_or(0, |(_, i)| i);
            if best.is_none() {
                ranks.insert(pair(0), merges.len());
                merges.push(pair(0));
            }
            let joined = format!("{}{}", pieces[at], pieces[at + 1]);
            pieces.splice(at..at + 2, [joined]);
        }
    }
    merges
}

/// Writes the folder `tokenizer/` for `words` and sequences of `length` tokens, and returns the vocabulary's size.
pub fn write(folder: &Path, words: &[&str], length: usize) -> Result<usize> {
    let characters = byte_characters();
    let merges = merges_for(words, &characters);
    let singles = characters.iter().map(char::to_string);
    let ends = characters.iter().map(|c| format!("{c}</w>"));
    let joined = merges.iter().map(|(a, b)| format!("{a}{b}"));
    let tokens: Vec<String> = singles
        .chain(ends)
        .chain(joined)
        .chain([START.to_owned(), END.to_owned()])
        .collect();
    let vocab: Map<String, Value> = tokens
        .iter()
        .enumerate()
        .map(|(i, t)| (t.clone(), json!(i)))
        .collect();
    let mut text = String::from("#version: 0.2\n");
    for (a, b) in &merges {
        text.push_str(&format!("{a} {b}\n"));
    }
    let special = json!({"bos_token": START, "eos_token": END, "pad_token": END, "unk_token": END});
    let config = json!({"model_max_length": length, "tokenizer_class": "CLIPTokenizer"});
    std::fs::create_dir_all(folder).map_err(io("create", folder))?;
    for (name, content) in [
        ("vocab.json", Value::Object(vocab).to_string()),
        ("merges.txt", text),
        ("special_tokens_map.json", special.to_string()),
        ("tokenizer_config.json", config.to_string()),
    ] {
        let path = folder.join(name);
        std::fs::write(&path, content).map_err(io("write", &path))?;
    }
    Ok(tokens.len())
}

#[cfg(test)]
mod tests {
    use dipir_diffusion::tokenizer::Tokenizer;

    use super::*;
    use dipir_prior::caption::vocabulary;

    #[test]
    fn every_word_of_the_vocabulary_is_one_token() {
        let folder = tempfile::tempdir().expect("a folder");
        let size = write(folder.path(), &vocabulary(), 20).expect("written");
        let tokenizer = Tokenizer::load(folder.path()).expect("loads");
        assert_eq!(tokenizer.vocab_size(), size);
        let mut seen = std::collections::HashSet::new();
        for word in vocabulary() {
            let tokens = tokenizer.words(word).expect("tokens");
            assert_eq!(tokens.len(), 1, "{word}: {tokens:?}");
            assert!(seen.insert(tokens[0]), "{word} shares its token");
        }
        assert!(tokenizer.words("zebra").expect("tokens").len() > 1);
    }
}
