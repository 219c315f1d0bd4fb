//! Text encoders and tokenizers.
use std::collections::BTreeMap;
use std::path::Path;

use candle_core::{DType, Device, Tensor};
use dipir_diffusion::model::Model;
use dipir_diffusion::text_encoder::TextEncoder;
use dipir_diffusion::tokenizer::{Padding, Tokenizer};
use dipir_diffusion::weights::write_safetensors;

use super::{Outcome, family, model_folder, tensors};

#[test]
fn text_encoder_loads_with_and_without_the_prefix() -> Outcome {
    let with = family().join("text_encoder");
    let folder = tempfile::tempdir()?;
    std::fs::copy(with.join("config.json"), folder.path().join("config.json"))?;
    let without = tensors(&with.join("model.safetensors"))?
        .into_iter()
        .map(|(k, v)| (k.strip_prefix("text_model.").unwrap_or(&k).to_owned(), v))
        .collect();
    write_safetensors(
        &folder.path().join("model.safetensors"),
        &without,
        &BTreeMap::new(),
    )?;
    let tokens = vec![vec![1, 2, 3, 4]];
    let run = |folder: &Path| -> Result<Vec<f32>, Box<dyn std::error::Error>> {
        let encoder = TextEncoder::load(folder, DType::F32, &Device::Cpu)?;
        Ok(encoder.forward(&tokens, None)?.flatten_all()?.to_vec1()?)
    };
    assert_eq!(run(&with)?, run(folder.path())?);
    Ok(())
}

#[test]
fn tokenizer_takes_nothing_a_thousand_words_and_a_placeholder() -> Outcome {
    let mut tokenizer = Tokenizer::load(&family().join("tokenizer"))?;
    let empty = tokenizer.encode("")?;
    assert_eq!(empty.len(), 77);
    assert!(
        empty[1..].iter().all(|&t| t == empty[1]),
        "start marker, then end markers"
    );
    let long = tokenizer.encode(&"word ".repeat(1000))?;
    assert_eq!(long.len(), 77);
    assert_eq!(long[76], empty[1], "cut, but ended");
    tokenizer.add_placeholder("SKS", 5000);
    assert_eq!(
        tokenizer
            .words("a sks car")?
            .iter()
            .filter(|&&t| t == 5000)
            .count(),
        1
    );
    assert_eq!(tokenizer.words("sks")?, [5000]);
    assert!(!tokenizer.words("sksx")?.contains(&5000));
    Ok(())
}

/// Tokens of transformers' CLIPTokenizer, 5.24.
#[test]
fn markers_in_a_text_are_markers() -> Outcome {
    let tokenizer = Tokenizer::clip(Padding::End)?;
    for (text, wanted) in [
        ("a<|startoftext|>b", vec![320, 49406, 321]),
        ("<|endoftext|> x", vec![49407, 343]),
        ("<|ENDOFTEXT|>", vec![49407]),
    ] {
        assert_eq!(tokenizer.words(text)?, wanted, "{text}");
    }
    // Those of a folder have other numbers.
    let tokenizer = Tokenizer::load(&family().join("tokenizer"))?;
    let end = tokenizer.encode("")?[1];
    assert_eq!(tokenizer.words("<|endoftext|>")?, [end]);
    Ok(())
}

#[test]
fn placeholders_may_hold_punctuation_and_stand_beside_it() -> Outcome {
    let mut tokenizer = Tokenizer::load(&family().join("tokenizer"))?;
    let plain = tokenizer.words("the style of")?;
    let comma = tokenizer.words(",")?;
    for (token, word) in (5000..).zip(["<SKS>", "*", "sks", "car", "sks-2", ""]) {
        tokenizer.add_placeholder(word, token);
    }
    let around = |token: u32| [&plain[..], &[token], &plain[..]].concat();
    for (word, token) in [("<sks>", 5000), ("*", 5001), ("Sks", 5002), ("sks-2", 5004)] {
        let text = format!("the style of {word} the style of");
        assert_eq!(tokenizer.words(&text)?, around(token), "{word}");
    }
    assert_eq!(
        tokenizer.words("sks, <sks>sks-car")?,
        [
            &[5002],
            &comma[..],
            &[5000, 5002],
            &tokenizer.words("-")?[..],
            &[5003]
        ]
        .concat()
    );
    // Longer words that only begin or end as a placeholder are not it.
    for word in ["sksx", "xsks", "cars", "sks1"] {
        assert!(tokenizer.words(word)?.iter().all(|&t| t < 5000), "{word}");
    }
    assert_eq!(tokenizer.words("ﾖ İ *")?.last(), Some(&5001));
    Ok(())
}

#[test]
fn tokenizer_json_alone_gives_the_same_tokens() -> Outcome {
    let source = family().join("tokenizer");
    let vocab: serde_json::Value =
        serde_json::from_slice(&std::fs::read(source.join("vocab.json"))?)?;
    let merges = std::fs::read_to_string(source.join("merges.txt"))?;
    let merges: Vec<&str> = merges.lines().skip(1).filter(|l| !l.is_empty()).collect();
    let folder = tempfile::tempdir()?;
    let json = serde_json::json!({"model": {"type": "BPE", "vocab": vocab, "merges": merges}});
    std::fs::write(folder.path().join("tokenizer.json"), json.to_string())?;
    let (a, b) = (Tokenizer::load(&source)?, Tokenizer::load(folder.path())?);
    let prompt = "a photo of the strangest 12 cars, isn't it? ☺";
    assert_eq!(a.encode(prompt)?, b.encode(prompt)?);
    Ok(())
}

#[test]
fn added_tokens_are_words_with_embeddings_of_their_own() -> Outcome {
    let folder = model_folder()?;
    let plain = Tokenizer::load(&folder.path().join("tokenizer"))?;
    let first = plain.vocab_size() as u32;
    let (before, after) = (plain.words("a photo of a")?, plain.words("in rain")?);
    let listed =
        |id: u32, word: &str| serde_json::json!({"id": id, "content": word, "special": false});
    let all = [
        (first, "<cat>"),
        (first + 1, "<dog>"),
        (first + 2, "<dog>_1"),
    ];
    let list: Vec<_> = all.iter().map(|(id, word)| listed(*id, word)).collect();
    let map: serde_json::Map<_, _> = all
        .iter()
        .map(|(id, w)| ((*w).into(), (*id).into()))
        .collect();
    let decoder: serde_json::Map<_, _> = all
        .iter()
        .map(|(id, w)| (id.to_string(), listed(*id, w)))
        .collect();
    for (name, text) in [
        ("added_tokens.json", serde_json::json!(map)),
        (
            "tokenizer_config.json",
            serde_json::json!({"added_tokens_decoder": decoder}),
        ),
        ("tokenizer.json", serde_json::json!({"added_tokens": list})),
    ] {
        let path = folder.path().join("tokenizer").join(name);
        let earlier = std::fs::read(&path).ok();
        std::fs::write(&path, text.to_string())?;
        let tokenizer = Tokenizer::load(&folder.path().join("tokenizer"))?;
        assert_eq!(tokenizer.vocab_size(), first as usize + 3, "{name}");
        for (word, own) in [("<Cat>", &[first][..]), ("<dog>", &[first + 1, first + 2])] {
            let words = tokenizer.words(&format!("a photo of a {word} in rain"))?;
            assert_eq!(words, [&before[..], own, &after].concat(), "{name}");
        }
        // The embeddings are the text encoder's.
        let message = Model::load(folder.path(), DType::F32, &Device::Cpu).expect_err(name);
        let wanted = format!(
            "tokenizer has {} tokens, text_encoder has vocab_size",
            first + 3
        );
        assert!(message.to_string().contains(&wanted), "{message}");
        match earlier {
            Some(text) => std::fs::write(&path, text)?,
            None => std::fs::remove_file(&path)?,
        }
    }
    let text = folder.path().join("text_encoder");
    let mut weights = tensors(&text.join("model.safetensors"))?;
    let table = weights
        .get_mut("text_model.embeddings.token_embedding.weight")
        .ok_or("no table")?;
    let own = (Tensor::ones((3, table.dims()[1]), DType::F32, &Device::Cpu)? * 0.1)?;
    *table = Tensor::cat(&[&*table, &own], 0)?;
    let size = table.dims()[0];
    write_safetensors(&text.join("model.safetensors"), &weights, &BTreeMap::new())?;
    let config = std::fs::read_to_string(text.join("config.json"))?;
    let mut config: serde_json::Value = serde_json::from_str(&config)?;
    config["vocab_size"] = size.into();
    std::fs::write(text.join("config.json"), config.to_string())?;
    let path = folder.path().join("tokenizer/added_tokens.json");
    std::fs::write(path, serde_json::json!(map).to_string())?;
    let model = Model::load(folder.path(), DType::F32, &Device::Cpu)?;
    model.encode_prompts(&["a <cat>"], None)?;
    let values = model.text_encoder.embedding(first)?.to_vec1::<f32>()?;
    assert_eq!(values[0], 0.1);
    Ok(())
}
