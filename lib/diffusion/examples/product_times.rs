//! Times both engines of the matrix product on the shapes that the networks have. Prints for each
//! shape the processor's milliseconds on one thread, the least of several runs in turns, and
//! their ratio.
//!
//!     product_times REPETITIONS

use std::time::Instant;

#[allow(dead_code, unused_imports)]
#[path = "../src/kernels/mod.rs"]
mod kernels;

use kernels::matmul::{Engine, Matrix, Threads, product_by};

/// Name, rows, columns, depth, and whether the right-hand matrix is stored transposed.
type Shape = (&'static str, [usize; 3], bool);

const SHAPES: [Shape; 15] = [
    ("linear 320 to 1280", [4096, 1280, 320], true),
    ("linear 1280 to 320", [4096, 320, 1280], true),
    ("linear 320 to 320", [4096, 320, 320], true),
    ("linear 1280 to 1280", [256, 1280, 1280], true),
    ("linear, input's gradient", [4096, 320, 1280], false),
    ("linear, weights' gradient", [1280, 320, 4096], false),
    ("text encoder, 768 to 3072", [77, 3072, 768], true),
    ("scores, 40 channels", [128, 4096, 40], true),
    ("values, 40 channels", [128, 40, 4096], false),
    ("scores, 160 channels", [64, 64, 160], true),
    ("unfolded, 1280 channels", [1280, 256, 11520], false),
    ("small linear, 64 to 64", [64, 64, 64], true),
    ("small linear, 128 to 1024", [16, 1024, 128], true),
    ("small scores, 32 channels", [64, 64, 32], true),
    ("small time, 128 to 128", [1, 128, 128], true),
];

/// Seconds of this thread on the processor.
fn processor_s() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanoseconds = text.split(' ').next().and_then(|t| t.parse::<f64>().ok());
    nanoseconds.unwrap_or(0.0) * 1e-9
}

/// Milliseconds of one product.
fn time(engine: Engine, [m, n, k]: [usize; 3], transposed: bool, values: &[f32]) -> f64 {
    let (a, b) = (&values[..m * k], &values[..k * n]);
    let b = match transposed {
        true => Matrix::rows(b, k).transposed(),
        false => Matrix::rows(b, n),
    };
    let mut out = vec![0.0; m * n];
    // Long enough for the clock, 20 ms at 50 Gflop/s.
    let times = (500_000_000 / (m * n * k)).max(1);
    let (wall, processor) = (Instant::now(), processor_s());
    for _ in 0..times {
        let (size, a) = ((m, n, k), Matrix::rows(a, k));
        // SAFETY: `out` holds m rows of n elements.
        unsafe {
            let out = out.as_mut_ptr();
            product_by(engine, size, out, n, 0.0, 1.0, a, b, Threads::One);
        }
    }
    let spent = match processor_s() - processor {
        spent if spent > 0.0 => spent,
        _ => wall.elapsed().as_secs_f64(),
    };
    std::hint::black_box(&out);
    spent * 1e3 / times as f64
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let repetitions: usize = std::env::args()
        .nth(1)
        .ok_or("usage: product_times REPETITIONS")?
        .parse()?;
    if Engine::best() == Engine::Gemm {
        return Err("this processor has no AVX-512: there is nothing to compare".into());
    }
    println!("| product | rows x columns x depth | panels, ms | gemm, ms | gemm / panels |");
    println!("|---|---|--:|--:|--:|");
    for (name, shape, transposed) in SHAPES {
        let [m, n, k] = shape;
        let values: Vec<f32> = (0..m.max(n) * k)
            .map(|i| (i % 251) as f32 / 251.0 - 0.5)
            .collect();
        let mut best = [f64::INFINITY; 2];
        for _ in 0..repetitions {
            for (best, engine) in best.iter_mut().zip([Engine::Panels, Engine::Gemm]) {
                *best = best.min(time(engine, shape, transposed, &values));
            }
        }
        let [panels, gemm] = best;
        println!(
            "| {name} | {m} x {n} x {k} | {panels:.4} | {gemm:.4} | {:.2} |",
            gemm / panels
        );
    }
    Ok(())
}
