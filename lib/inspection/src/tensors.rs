//! Safetensors: names, shapes, types, metadata, ranges. The header is not trusted: the library
//! that reads it bounds its size and checks that shapes, types and offsets fill the file exactly.
use std::fs::File;
use std::path::Path;

use dipir_cli::output::json_path;
use half::{bf16, f16};
use memmap2::Mmap;
use rayon::prelude::*;
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use serde_json::{Value, json};

use crate::range::Range;
use crate::report::{Report, Table};

pub(crate) fn inspect(path: &Path) -> anyhow::Result<Report> {
    let unreadable = |e: std::io::Error| {
        anyhow::anyhow!("cannot read {}: {}", path.display(), crate::reason(&e))
    };
    let file = File::open(path).map_err(unreadable)?;
    // SAFETY: the map is only read. If another process truncates the file meanwhile, this one ends
    // with a bus error. A program that only shows files may risk that, to read files larger than
    // memory.
    let bytes = unsafe { Mmap::map(&file) }.map_err(unreadable)?;
    let refused = |e: safetensors::SafeTensorError| {
        anyhow::anyhow!(
            "{}: not a valid safetensors file: {e}; download or make it anew",
            path.display()
        )
    };
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(refused)?;
    let tensors = SafeTensors::deserialize(&bytes).map_err(refused)?;
    let mut metadata: Vec<(String, String)> = header
        .metadata()
        .clone()
        .unwrap_or_default()
        .into_iter()
        .collect();
    metadata.sort();
    let mut views: Vec<(String, TensorView)> = tensors.tensors();
    views.sort_by(|a, b| a.0.cmp(&b.0));
    let ranges: Vec<Option<Range>> = views.par_iter().map(|(_, view)| range(view)).collect();

    let mut table = Table::new(&["tensor", "type", ">shape", ">min", ">mean", ">max", ""]);
    let mut entries = serde_json::Map::new();
    let mut elements = 0u64;
    for ((name, view), range) in views.iter().zip(&ranges) {
        elements += view.shape().iter().map(|&n| n as u64).product::<u64>();
        let shape: Vec<String> = view.shape().iter().map(ToString::to_string).collect();
        let dtype = format!("{:?}", view.dtype());
        table.row(
            [name.clone(), dtype.clone(), shape.join(" x ")]
                .into_iter()
                .chain(cells(*range)),
        );
        let mut entry = range.map_or(json!({}), Range::to_json);
        entry["dtype"] = dtype.into();
        entry["shape"] = view.shape().into();
        entries.insert(name.clone(), entry);
    }
    let mut text = table.render();
    for (key, value) in &metadata {
        text.push_str(&format!("  {key}: {}\n", value.replace('\n', " ")));
    }
    let metadata: serde_json::Map<String, Value> =
        metadata.into_iter().map(|(k, v)| (k, v.into())).collect();
    Ok(Report {
        title: format!(
            "{}: safetensors, {} tensors, {elements} elements",
            path.display(),
            views.len()
        ),
        text,
        json: json!({
            "path": json_path(path), "kind": "safetensors", "elements": elements,
            "tensors": entries, "metadata": metadata,
        }),
        problems: Vec::new(),
    })
}

/// The range of a tensor's values; `None` for types without a plain number.
fn range(view: &TensorView) -> Option<Range> {
    let data = view.data();
    Some(match view.dtype() {
        Dtype::F32 => of(data, |b| f32::from_le_bytes(b).into()),
        Dtype::F16 => of(data, |b| f16::from_le_bytes(b).into()),
        Dtype::BF16 => of(data, |b| bf16::from_le_bytes(b).into()),
        Dtype::F64 => of(data, f64::from_le_bytes),
        Dtype::I64 => of(data, |b| i64::from_le_bytes(b) as f64),
        Dtype::U64 => of(data, |b| u64::from_le_bytes(b) as f64),
        Dtype::I32 => of(data, |b| i32::from_le_bytes(b).into()),
        Dtype::U32 => of(data, |b| u32::from_le_bytes(b).into()),
        Dtype::I16 => of(data, |b| i16::from_le_bytes(b).into()),
        Dtype::U16 => of(data, |b| u16::from_le_bytes(b).into()),
        Dtype::I8 => of(data, |b| i8::from_le_bytes(b).into()),
        Dtype::U8 | Dtype::BOOL => of(data, |b| u8::from_le_bytes(b).into()),
        _ => return None,
    })
}

fn of<const N: usize>(data: &[u8], read: impl Fn([u8; N]) -> f64) -> Range {
    Range::of(data.as_chunks::<N>().0.iter().map(|&b| read(b)))
}

/// What a table says of a tensor's values.
fn cells(range: Option<Range>) -> [String; 4] {
    let none = || ["-", "-", "-", "no statistics of this type"].map(String::from);
    range.map_or_else(none, Range::cells)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn doubles_keep_their_precision_and_types_without_statistics_say_so() -> anyhow::Result<()> {
        let wide: Vec<u8> = [1e300f64, 1.0 + 1e-12].map(f64::to_le_bytes).concat();
        let found = range(&TensorView::new(Dtype::F64, vec![2], &wide)?);
        let ends = found.map(|r| (r.min, r.max));
        assert_eq!(ends, Some((1.0 + 1e-12, 1e300)));
        let found = range(&TensorView::new(Dtype::F8_E4M3, vec![1], &[7])?);
        assert_eq!(cells(found), ["-", "-", "-", "no statistics of this type"]);
        Ok(())
    }
}
