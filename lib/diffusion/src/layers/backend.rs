//! Which of its two forms a layer uses.

use std::cell::Cell;

use candle_core::Tensor;

thread_local! {
    static COMPOSED: Cell<bool> = const { Cell::new(false) };
}

/// Runs `work` with every layer composed of candle's operations, as on devices without kernels of the crate's own. Holds
/// for this thread. It is slower and takes more memory: it is what the kernels are compared with.
pub fn composed<T>(work: impl FnOnce() -> T) -> T {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            COMPOSED.set(self.0);
        }
    }
    let _restore = Restore(COMPOSED.replace(true));
    work()
}

/// Whether the CPU's kernels compute what is asked of `x`.
pub(super) fn has_kernels(x: &Tensor) -> bool {
    x.device().is_cpu() && !COMPOSED.get()
}

/// As [`has_kernels`], or a GPU's do: those of layers whose `parameters` are constants.
pub(super) fn has_kernels_anywhere(x: &Tensor, parameters: &[&Tensor]) -> bool {
    let on_gpu = cfg!(feature = "cuda") && x.device().is_cuda() && !COMPOSED.get();
    has_kernels(x) || (on_gpu && !parameters.iter().any(|p| p.track_op()))
}
