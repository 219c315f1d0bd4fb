//! Where a photograph is looked at to learn how its camera draws: squares spread over it.
use crate::resize::PixelBox;

/// Side of a square, pixels.
const SIDE: usize = 128;
/// Squares along the longer side of a large photograph.
const MOST: usize = 16;

/// Squares spread evenly over a photograph of `width` x `height` pixels: all of a small one, at most 256 of a large one.
/// What is narrower than a square is looked at as far as it reaches.
pub(crate) fn squares(width: usize, height: usize) -> Vec<PixelBox> {
    let (columns, rows) = (starts(width), starts(height));
    let at = |&y: &usize| {
        columns.iter().map(move |&x| PixelBox {
            x,
            y,
            width: SIDE.min(width),
            height: SIDE.min(height),
        })
    };
    rows.iter().flat_map(at).collect()
}

/// Where the squares of a line of `length` pixels begin.
fn starts(length: usize) -> Vec<usize> {
    let fit = (length / SIDE).max(1);
    let taken = fit.min(MOST);
    let room = length.saturating_sub(SIDE);
    match taken {
        1 => vec![room / 2],
        _ => (0..taken).map(|i| room * i / (taken - 1)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_lie_inside_and_reach_both_ends() {
        for (width, height) in [(1, 1), (127, 300), (128, 128), (960, 640), (9000, 2000)] {
            let all = squares(width, height);
            assert!(!all.is_empty() && all.len() <= MOST * MOST);
            for b in &all {
                assert!(b.x + b.width <= width && b.y + b.height <= height, "{b:?}");
            }
            if width >= 2 * SIDE {
                assert_eq!(all.iter().map(|b| b.x).min(), Some(0));
                assert_eq!(all.iter().map(|b| b.x + b.width).max(), Some(width));
            }
        }
    }
}
