//! Attention of heads that lie side by side: q [batch, queries, heads * size], k and v [batch, keys, heads * size]. Scores are
//! f32 and exist for a few heads at a time.

use candle_core::cuda_backend::cudarc::driver::sys::CUdevice_attribute;
use candle_core::{CudaStorage, DType, Result};

use super::gemm::{Matrices, products};
use super::{Argument, FLASH, SCRATCH, View, alike, empty, launch, launch_of, whole};
use crate::kernels::attention::AttentionShape;

/// A sample and some of its heads.
#[derive(Clone, Copy)]
struct Heads {
    sample: usize,
    first: usize,
    count: usize,
}

/// Sizes, and arrays for the scores of some heads.
struct Work<'a> {
    s: &'a AttentionShape,
    heads_at_once: usize,
    scores: View<'a>,
    weights: View<'a>,
}

impl Work<'_> {
    fn parts(&self) -> impl Iterator<Item = Heads> + '_ {
        (0..self.s.batch).flat_map(move |sample| {
            let starts = (0..self.s.heads).step_by(self.heads_at_once);
            starts.map(move |first| Heads {
                sample,
                first,
                count: self.heads_at_once.min(self.s.heads - first),
            })
        })
    }

    /// These heads of an array whose samples have `length` rows.
    fn heads<'a>(&self, array: View<'a>, length: usize, part: Heads) -> Matrices<'a> {
        let width = self.s.heads * self.s.head_dim;
        let first = part.sample * length * width + part.first * self.s.head_dim;
        Matrices::new(array.at(first), width, self.s.head_dim)
    }

    fn queries<'a>(&self, array: View<'a>, part: Heads) -> Matrices<'a> {
        self.heads(array, self.s.queries, part)
    }

    fn keys<'a>(&self, array: View<'a>, part: Heads) -> Matrices<'a> {
        self.heads(array, self.s.keys, part)
    }

    /// An array [heads, queries, keys].
    fn square<'a>(&self, array: View<'a>) -> Matrices<'a> {
        Matrices::new(array, self.s.keys, self.s.queries * self.s.keys)
    }

    /// Fills the weights of these heads.
    fn fill_weights(&self, q: View, k: View, part: Heads) -> Result<()> {
        let s = self.s;
        let (q, k) = (self.queries(q, part), self.keys(k, part).transposed());
        products(
            part.count,
            (s.queries, s.head_dim, s.keys),
            q,
            k,
            self.square(self.scores),
        )?;
        let arguments = [
            self.scores.into(),
            self.weights.into(),
            s.keys.try_into()?,
            s.queries.try_into()?,
            usize::from(s.causal).try_into()?,
            s.scale.into(),
        ];
        self.launch("softmax", part, &arguments)
    }

    /// A block for every row of the scores.
    fn launch(&self, name: &str, part: Heads, arguments: &[Argument]) -> Result<()> {
        let pack = if self.s.keys.is_multiple_of(4) { 4 } else { 1 };
        let threads = (self.s.keys / pack).next_multiple_of(32).clamp(32, 256) as u32;
        let (name, rows) = (format!("{name}_{pack}"), part.count * self.s.queries);
        let kernel = (name.as_str(), self.weights.dtype);
        launch(self.scores.device, kernel, (rows, 1, 1), threads, arguments)
    }
}

/// Heads whose scores and weights fit into [`SCRATCH`], at least one.
fn heads_at_once(s: &AttentionShape) -> usize {
    (SCRATCH / (4 * s.queries * s.keys).max(1)).clamp(1, s.heads)
}

/// Whether the kernel that stores no scores serves: heads of 64 in half precision, on tensor cores.
fn has_flash(s: &AttentionShape, views: &[View]) -> bool {
    let capability = CUdevice_attribute::CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR;
    let context = views[0].device.cuda_stream().context().clone();
    s.head_dim == 64
        && !s.causal
        && views
            .iter()
            .all(|v| v.is_aligned() && v.dtype != DType::F32)
        && s.heads.max(s.batch) <= 65_535
        && context.attribute(capability).is_ok_and(|major| major >= 8)
}

/// Starts a kernel of `flash.cu` with a block for 128 of `rows`, a head and a sample; its last arguments are the sizes.
fn launch_flash(s: &AttentionShape, name: &str, rows: usize, views: &[View]) -> Result<()> {
    /// Rows of a block, and its threads.
    const ROWS: usize = 128;
    const THREADS: u32 = 256;
    let mut arguments: Vec<Argument> = views.iter().map(|&v| v.into()).collect();
    for size in [s.queries, s.keys, s.heads] {
        arguments.push(size.try_into()?);
    }
    arguments.push((s.scale * std::f32::consts::LOG2_E).into());
    let grid = (rows.div_ceil(ROWS), s.heads, s.batch);
    let (device, kernel) = (views[0].device, (name, views[0].dtype));
    launch_of(FLASH, device, kernel, grid, THREADS, &arguments)
}

fn flash(s: &AttentionShape, q: View, k: View, v: View) -> Result<CudaStorage> {
    let elements = s.batch * s.queries * s.heads * s.head_dim;
    let y = empty(q.device, q.dtype, elements)?;
    launch_flash(s, "flash", s.queries, &[q, k, v, whole(&y, elements)?])?;
    Ok(y)
}

fn flash_vjp(s: &AttentionShape, [q, k, v, y, g]: [View; 5]) -> Result<[CudaStorage; 3]> {
    let (device, width) = (q.device, s.heads * s.head_dim);
    let (of_queries, of_keys) = (s.batch * s.queries * width, s.batch * s.keys * width);
    // Of every query its largest score, the factor of its weights, and <g, y>.
    let rows = s.batch * s.heads * s.queries;
    let facts = empty(device, DType::F32, 3 * rows)?;
    let facts = whole(&facts, 3 * rows)?;
    let [tops, shares, dots] = [0, rows, 2 * rows].map(|first| facts.at(first));
    let [dq, dk, dv] = [of_queries, of_keys, of_keys].map(|n| empty(device, q.dtype, n));
    let (dq, dk, dv) = (dq?, dk?, dv?);
    let to_q = whole(&dq, of_queries)?;
    launch_flash(
        s,
        "flash_vjp_queries",
        s.queries,
        &[q, k, v, y, g, to_q, tops, shares, dots],
    )?;
    let (to_k, to_v) = (whole(&dk, of_keys)?, whole(&dv, of_keys)?);
    launch_flash(
        s,
        "flash_vjp_keys",
        s.keys,
        &[q, k, v, g, tops, shares, dots, to_k, to_v],
    )?;
    Ok([dq, dk, dv])
}

pub(crate) fn attention(s: AttentionShape, q: View, k: View, v: View) -> Result<CudaStorage> {
    let (dtype, device) = (alike(&[q, k, v])?, q.device);
    if has_flash(&s, &[q, k, v]) {
        return flash(&s, q, k, v);
    }
    let heads_at_once = heads_at_once(&s);
    let square = heads_at_once * s.queries * s.keys;
    let (scores, weights) = (
        empty(device, DType::F32, square)?,
        empty(device, dtype, square)?,
    );
    let work = Work {
        s: &s,
        heads_at_once,
        scores: whole(&scores, square)?,
        weights: whole(&weights, square)?,
    };
    let elements = s.batch * s.queries * s.heads * s.head_dim;
    let y = empty(device, dtype, elements)?;
    let to = whole(&y, elements)?;
    for part in work.parts() {
        work.fill_weights(q, k, part)?;
        products(
            part.count,
            (s.queries, s.keys, s.head_dim),
            work.square(work.weights),
            work.keys(v, part),
            work.queries(to, part),
        )?;
    }
    Ok(y)
}

/// Fewest keys for the adjoint without stored scores: its kernel by keys has a block for 128 of them, and fewer would leave
/// most of a GPU idle. Not measured.
const FLASH_KEYS: usize = 512;

/// The gradients at q, k and v, where that at the result y is `g`. The weights are computed again.
pub(crate) fn vjp(s: AttentionShape, views: [View; 5]) -> Result<[CudaStorage; 3]> {
    let [q, k, v, _, g] = views;
    let (dtype, device) = (alike(&views)?, q.device);
    if s.keys >= FLASH_KEYS && has_flash(&s, &views) {
        return flash_vjp(&s, views);
    }
    let heads_at_once = heads_at_once(&s);
    let square = heads_at_once * s.queries * s.keys;
    let (scores, weights) = (
        empty(device, DType::F32, square)?,
        empty(device, dtype, square)?,
    );
    let at_scores = empty(device, dtype, square)?;
    let at_scores = whole(&at_scores, square)?;
    let work = Work {
        s: &s,
        heads_at_once,
        scores: whole(&scores, square)?,
        weights: whole(&weights, square)?,
    };
    let width = s.heads * s.head_dim;
    let (of_queries, of_keys) = (s.batch * s.queries * width, s.batch * s.keys * width);
    let (dq, dk, dv) = (
        empty(device, dtype, of_queries)?,
        empty(device, dtype, of_keys)?,
        empty(device, dtype, of_keys)?,
    );
    let (to_q, to_k, to_v) = (
        whole(&dq, of_queries)?,
        whole(&dk, of_keys)?,
        whole(&dv, of_keys)?,
    );
    for part in work.parts() {
        work.fill_weights(q, k, part)?;
        let n = part.count;
        let (of_weights, of_scores) = (|| work.square(work.weights), || work.square(at_scores));
        products(
            n,
            (s.keys, s.queries, s.head_dim),
            of_weights().transposed(),
            work.queries(g, part),
            work.keys(to_v, part),
        )?;
        // The scores' place takes the gradient at the weights.
        products(
            n,
            (s.queries, s.head_dim, s.keys),
            work.queries(g, part),
            work.keys(v, part).transposed(),
            work.square(work.scores),
        )?;
        let arguments = [
            work.weights.into(),
            work.scores.into(),
            at_scores.into(),
            s.keys.try_into()?,
            s.scale.into(),
        ];
        work.launch("softmax_vjp", part, &arguments)?;
        products(
            n,
            (s.queries, s.keys, s.head_dim),
            of_scores(),
            work.keys(k, part),
            work.queries(to_q, part),
        )?;
        products(
            n,
            (s.keys, s.queries, s.head_dim),
            of_scores().transposed(),
            work.queries(q, part),
            work.keys(to_k, part),
        )?;
    }
    Ok([dq, dk, dv])
}
