//! Safetensors: names, shapes, types, metadata, ranges. The header is not trusted: the library
//! that reads it bounds its size and checks that shapes, types and offsets fill the file exactly.
use std::fs::File;
use std::path::Path;

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
        let cells = range.map_or_else(Default::default, Range::cells);
        let dtype = format!("{:?}", view.dtype());
        table.row(
            [name.clone(), dtype.clone(), shape.join(" x ")]
                .into_iter()
                .chain(cells),
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
            "path": path, "kind": "safetensors", "elements": elements,
            "tensors": entries, "metadata": metadata,
        }),
        problems: Vec::new(),
    })
}

/// The range of a tensor's values; `None` for types without a plain number.
fn range(view: &TensorView) -> Option<Range> {
    let data = view.data();
    let values: Vec<f32> = match view.dtype() {
        Dtype::F32 => numbers(data, f32::from_le_bytes),
        Dtype::F16 => numbers(data, |b| f16::from_le_bytes(b).to_f32()),
        Dtype::BF16 => numbers(data, |b| bf16::from_le_bytes(b).to_f32()),
        Dtype::F64 => numbers(data, |b| f64::from_le_bytes(b) as f32),
        Dtype::I64 => numbers(data, |b| i64::from_le_bytes(b) as f32),
        Dtype::I32 => numbers(data, |b| i32::from_le_bytes(b) as f32),
        Dtype::U32 => numbers(data, |b| u32::from_le_bytes(b) as f32),
        Dtype::I16 => numbers(data, |b| i16::from_le_bytes(b) as f32),
        Dtype::U16 => numbers(data, |b| u16::from_le_bytes(b) as f32),
        Dtype::U8 | Dtype::BOOL => data.iter().map(|&b| b.into()).collect(),
        _ => return None,
    };
    Some(Range::of(&values))
}

fn numbers<const N: usize>(data: &[u8], read: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    data.as_chunks::<N>().0.iter().map(|&b| read(b)).collect()
}
