use super::super::matmul::{Columns, Engine, product_by, product_columns, product_onto_rows};
use super::*;

/// Against sums in f64, for sizes at and off every block's border, all
/// four orders of storage, both ways of treating what was there, and
/// every engine that this processor can run.
#[test]
fn products_of_every_engine_match_f64_for_odd_sizes_and_strides() {
    let mut engines = vec![Engine::Gemm];
    if available() {
        engines.push(Engine::Panels);
    }
    let threads = |engine| [(engine, Threads::One), (engine, Threads::All)];
    let runs: Vec<_> = engines.into_iter().flat_map(threads).collect();
    let value = |i: usize| ((i * 2_654_435_761) % 1000) as f32 / 500.0 - 1.0;
    for (m, n, k) in [
        (1, 1, 1),
        (14, 32, 256),
        (15, 33, 257),
        (3, 700, 40),
        (350, 5, 7),
        (40, 40, 600),
        (30, 33, 641),
        // Two jobs, and two blocks of packed columns.
        (20, 700, 40),
        (2, 4100, 3),
        (2, 3, 0),
    ] {
        let a: Vec<f32> = (0..m * k).map(value).collect();
        let b: Vec<f32> = (0..n * k).map(|i| value(i + 7)).collect();
        for (a_row, a_column, b_row, b_column) in
            [(k, 1, n, 1), (1, m, n, 1), (k, 1, 1, k), (1, m, 1, k)]
        {
            for keep in [0.0, 1.0, 0.5] {
                let start: Vec<f32> = if keep == 0.0 {
                    vec![f32::NAN; m * n]
                } else {
                    (0..m * n).map(value).collect()
                };
                for (engine, threads) in &runs {
                    let a_view = Matrix {
                        data: &a,
                        row: a_row,
                        column: a_column,
                    };
                    let b_view = Matrix {
                        data: &b,
                        row: b_row,
                        column: b_column,
                    };
                    let (size, mut out) = ((m, n, k), start.clone());
                    // SAFETY: `out` holds m rows of n elements.
                    unsafe {
                        let out = out.as_mut_ptr();
                        product_by(*engine, size, out, n, keep, 1.0, a_view, b_view, *threads);
                    }
                    let columns = Columns::new(*engine, b_view, (k, n));
                    let mut again = start.clone();
                    // SAFETY: as above.
                    unsafe {
                        let out = again.as_mut_ptr();
                        let b = &columns;
                        product_columns(size, out, n, keep, 1.0, a_view, b, *threads);
                    }
                    let same = |(a, b): (&f32, &f32)| a.to_bits() == b.to_bits();
                    assert!(
                        out.iter().zip(&again).all(same),
                        "{engine:?} {m}x{n}x{k}: packed ahead gives other bytes"
                    );
                    if keep == 1.0 {
                        let row = &start[..n];
                        let mut wanted = row.repeat(m);
                        // SAFETY: as above.
                        unsafe {
                            let out = wanted.as_mut_ptr();
                            let b = b_view;
                            product_by(*engine, size, out, n, 1.0, 1.0, a_view, b, *threads);
                        }
                        let onto = product_onto_rows(*engine, size, row, a_view, b_view);
                        assert!(
                            onto.iter().zip(&wanted).all(same),
                            "{engine:?} {m}x{n}x{k}: onto rows gives other bytes"
                        );
                    }
                    for i in 0..m {
                        for j in 0..n {
                            let mut sum = if keep == 0.0 {
                                0.0
                            } else {
                                keep as f64 * start[i * n + j] as f64
                            };
                            let mut size = sum.abs();
                            for p in 0..k {
                                let term = a[i * a_row + p * a_column] as f64
                                    * b[p * b_row + j * b_column] as f64;
                                sum += term;
                                size += term.abs();
                            }
                            // The bound of any order of summation [Higham 2002, 4.4].
                            let tolerance = (k + 3) as f64 * (-24f64).exp2() * size + 1e-30;
                            let error = (out[i * n + j] as f64 - sum).abs();
                            assert!(
                                error <= tolerance,
                                "{engine:?} {m}x{n}x{k} at {i},{j}: {} not {sum}",
                                out[i * n + j]
                            );
                        }
                    }
                }
            }
        }
    }
}
