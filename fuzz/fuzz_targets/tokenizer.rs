#![no_main]
use dipir_diffusion::tokenizer::Tokenizer;
use libfuzzer_sys::fuzz_target;

/// The files of a tokenizer's folder, one after the other with a byte 0 between them.
const FILES: [&str; 4] = [
    "vocab.json",
    "merges.txt",
    "tokenizer_config.json",
    "tokenizer.json",
];

fuzz_target!(|bytes: &[u8]| {
    let name = format!("dipir-fuzz-tokenizer-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    if std::fs::create_dir_all(&folder).is_ok() {
        for (name, content) in FILES.iter().zip(bytes.split(|&b| b == 0)) {
            if !content.is_empty() {
                let _ = std::fs::write(folder.join(name), content);
            }
        }
        if let Ok(tokenizer) = Tokenizer::load(&folder) {
            if let Ok(tokens) = tokenizer.encode("Ab ba <|endoftext|> 1") {
                assert_eq!(tokens.len(), tokenizer.length());
            }
        }
        let _ = std::fs::remove_dir_all(&folder);
    }
});
