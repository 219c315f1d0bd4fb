//! Which files of a repository make a model.

use crate::client::{RemoteFile, Revision};
use crate::error::{Error, Result};

/// Which of the published weights.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Variant {
    /// Full precision where it is published, else half.
    #[default]
    Full,
    /// Half precision: `*.fp16.safetensors`, half the bytes.
    Half,
}

/// The parts that have weights, and the first part of their files' names.
const WEIGHTS: [(&str, &str); 3] = [
    ("unet", "diffusion_pytorch_model"),
    ("vae", "diffusion_pytorch_model"),
    ("text_encoder", "model"),
];

/// The files of a model in the diffusers layout: configurations, tokenizer,
/// schedule and one set of safetensors for each part. Nothing else of the
/// repository is wanted: no pickles, no other frameworks, no safety checker.
/// Everything that is missing is named in one error.
pub fn select(revision: &Revision, variant: Variant) -> Result<Vec<RemoteFile>> {
    let find = |path: &str| revision.files.iter().find(|f| f.path == path);
    let mut wanted: Vec<&RemoteFile> = vec![];
    let mut problems = vec![];
    let mut take = |path: &str, problems: &mut Vec<String>| match find(path) {
        Some(file) => wanted.push(file),
        None => problems.push(format!("{path} is missing")),
    };
    take("model_index.json", &mut problems);
    take("scheduler/scheduler_config.json", &mut problems);
    if find("tokenizer/vocab.json").is_some() || find("tokenizer/tokenizer.json").is_none() {
        take("tokenizer/vocab.json", &mut problems);
        take("tokenizer/merges.txt", &mut problems);
    } else {
        take("tokenizer/tokenizer.json", &mut problems);
    }
    for (part, _) in WEIGHTS {
        take(&format!("{part}/config.json"), &mut problems);
    }
    for optional in [
        "added_tokens.json",
        "special_tokens_map.json",
        "tokenizer_config.json",
    ] {
        wanted.extend(find(&format!("tokenizer/{optional}")));
    }
    for (part, stem) in WEIGHTS {
        match weights(&revision.files, part, stem, variant) {
            Some(files) => wanted.extend(files),
            None => problems.push(format!(
                "{part}: {}",
                lacking(&revision.files, part, stem, variant)
            )),
        }
    }
    if !problems.is_empty() {
        return Err(Error::Layout {
            repo: revision.repo.clone(),
            problems,
        });
    }
    let mut wanted: Vec<RemoteFile> = wanted.into_iter().cloned().collect();
    wanted.sort_by(|a, b| a.path.cmp(&b.path));
    wanted.dedup();
    Ok(wanted)
}

/// One complete set of a part's weights: a single file, or shards with their
/// index.
fn weights<'a>(
    files: &'a [RemoteFile],
    part: &str,
    stem: &str,
    variant: Variant,
) -> Option<Vec<&'a RemoteFile>> {
    let order: &[&str] = match variant {
        Variant::Full => &["", ".fp16"],
        Variant::Half => &[".fp16"],
    };
    order.iter().find_map(|half| {
        let single = format!("{part}/{stem}{half}.safetensors");
        if let Some(file) = files.iter().find(|f| f.path == single) {
            return Some(vec![file]);
        }
        let index = [
            format!("{part}/{stem}.safetensors.index{half}.json"),
            format!("{part}/{stem}{half}.safetensors.index.json"),
        ];
        let index = files.iter().find(|f| index.contains(&f.path))?;
        let start = format!("{part}/{stem}{half}-");
        let shard_of = |f: &'a RemoteFile| {
            let rest = f.path.strip_prefix(&start)?;
            Some((f, shard(rest.strip_suffix(".safetensors")?)?))
        };
        let (mut all, numbers): (Vec<&RemoteFile>, Vec<(usize, usize)>) =
            files.iter().filter_map(shard_of).unzip();
        let is_whole = |count: usize| (1..=count).all(|n| numbers.contains(&(n, count)));
        if !numbers.iter().any(|&(_, count)| is_whole(count)) {
            return None;
        }
        all.push(index);
        Some(all)
    })
}

/// `00001-of-00002` as (1, 2).
fn shard(text: &str) -> Option<(usize, usize)> {
    let number = |t: &str| {
        let digits = t.bytes().all(|b| b.is_ascii_digit());
        digits.then(|| t.parse().ok()).flatten()
    };
    let (n, count) = text.split_once("-of-")?;
    Some((number(n)?, number(count)?))
}

fn lacking(files: &[RemoteFile], part: &str, stem: &str, variant: Variant) -> String {
    let has = |end: &str| {
        files
            .iter()
            .any(|f| f.path == format!("{part}/{stem}{end}"))
    };
    if variant == Variant::Half && weights(files, part, stem, Variant::Full).is_some() {
        return format!("no {stem}.fp16.safetensors, only full precision; leave --variant out");
    }
    let indices = [
        ".safetensors.index.json",
        ".safetensors.index.fp16.json",
        ".fp16.safetensors.index.json",
    ];
    if indices.into_iter().any(has) {
        return format!(
            "there is an index of {stem}, but not all of its shards; take another revision"
        );
    }
    if has(".bin") || has(".fp16.bin") {
        return format!(
            "no {stem}.safetensors, only pickles; take another revision, or convert it with diffusers' save_pretrained(..., safe_serialization=True)"
        );
    }
    format!("no {stem}.safetensors; is it a complete pipeline and not a part of one?")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn revision(paths: &[&str]) -> Revision {
        let file = |path: &&str| RemoteFile {
            path: path.to_string(),
            size: None,
            sha256: None,
            git_hash: None,
        };
        Revision {
            repo: "a/b".into(),
            commit: "0".into(),
            files: paths.iter().map(file).collect(),
        }
    }

    const COMMON: [&str; 8] = [
        "model_index.json",
        "scheduler/scheduler_config.json",
        "tokenizer/vocab.json",
        "tokenizer/merges.txt",
        "unet/config.json",
        "vae/config.json",
        "text_encoder/config.json",
        "vae/diffusion_pytorch_model.safetensors",
    ];

    fn names(paths: &[&str], variant: Variant) -> Result<Vec<String>> {
        let all: Vec<&str> = COMMON.iter().chain(paths).copied().collect();
        Ok(select(&revision(&all), variant)?
            .into_iter()
            .map(|f| f.path)
            .collect())
    }

    #[test]
    fn one_set_of_weights_is_taken_and_nothing_else() {
        let published = [
            "v1-5-pruned.ckpt",
            "README.md",
            "safety_checker/model.safetensors",
            "unet/diffusion_pytorch_model.bin",
            "unet/diffusion_pytorch_model.fp16.safetensors",
            "unet/diffusion_pytorch_model.non_ema.safetensors",
            "unet/diffusion_pytorch_model.safetensors",
            "text_encoder/model.safetensors",
            "text_encoder/model.fp16.safetensors",
            "vae/diffusion_pytorch_model.fp16.safetensors",
            "tokenizer/special_tokens_map.json",
            "tokenizer/added_tokens.json",
        ];
        let full = names(&published, Variant::Full).expect("complete");
        assert_eq!(full.len(), COMMON.len() + 4, "{full:?}");
        // The tokenizer reads it: words of their own, as textual inversion adds them.
        assert!(full.contains(&"tokenizer/added_tokens.json".to_owned()));
        assert!(full.contains(&"unet/diffusion_pytorch_model.safetensors".to_owned()));
        let half = names(&published, Variant::Half).expect("complete");
        assert_eq!(half.len(), COMMON.len() + 4, "{half:?}");
        assert!(
            half.iter()
                .filter(|n| n.ends_with(".safetensors"))
                .all(|n| n.contains(".fp16."))
        );
    }

    #[test]
    fn shards_come_with_their_index_and_hostile_names_do_not() {
        let published = [
            "text_encoder/model.safetensors",
            "unet/diffusion_pytorch_model.safetensors.index.json",
            "unet/diffusion_pytorch_model-00001-of-00002.safetensors",
            "unet/diffusion_pytorch_model-00002-of-00002.safetensors",
            "unet/diffusion_pytorch_model-../../../x.safetensors",
            "../../../etc/model.safetensors",
        ];
        let found = names(&published, Variant::Full).expect("complete");
        assert_eq!(found.iter().filter(|n| n.starts_with("unet/")).count(), 4);
        assert!(!found.iter().any(|n| n.contains("..")), "{found:?}");
        // Without the second one, or with an index alone, it is no model.
        for left in [3, 2] {
            let message = names(&published[..left], Variant::Full)
                .expect_err("a shard is missing")
                .to_string();
            let wanted =
                "unet: there is an index of diffusion_pytorch_model, but not all of its shards";
            assert!(message.contains(wanted), "{message}");
        }
    }

    #[test]
    fn everything_that_is_missing_is_named_at_once() {
        let message = select(
            &revision(&["unet/diffusion_pytorch_model.bin"]),
            Variant::Full,
        )
        .expect_err("incomplete")
        .to_string();
        for part in [
            "model_index.json is missing",
            "tokenizer/vocab.json is missing",
            "unet: no diffusion_pytorch_model.safetensors, only pickles",
            "text_encoder: no model.safetensors",
        ] {
            assert!(message.contains(part), "{message}");
        }
        let full_only = [
            "unet/diffusion_pytorch_model.safetensors",
            "text_encoder/model.safetensors",
        ];
        let message = names(&full_only, Variant::Half)
            .expect_err("no half")
            .to_string();
        assert!(message.contains("leave --variant out"), "{message}");
    }
}
