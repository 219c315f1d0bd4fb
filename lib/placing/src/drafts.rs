//! Which of the pictures that were asked for is the newest.
use std::ops::ControlFlow;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Tabs of a browser that are told apart; of more, some break off each other's pictures.
const TABS: usize = 64;

/// Counts pictures that were asked for, tab by tab.
pub(crate) struct Drafts(Arc<[AtomicU64; TABS]>);

impl Default for Drafts {
    fn default() -> Self {
        Self(Arc::new([const { AtomicU64::new(0) }; TABS]))
    }
}

impl Drafts {
    /// Breaks off older pictures of a tab; whether there is none newer than this.
    pub(crate) fn newest(&self, tab: u32) -> impl Fn() -> ControlFlow<()> + Send + 'static {
        let slot = tab as usize % TABS;
        let counts = self.0.clone();
        let ticket = counts[slot].fetch_add(1, Ordering::SeqCst) + 1;
        move || match counts[slot].load(Ordering::SeqCst) == ticket {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newer_picture_breaks_off_those_of_its_own_tab_alone() {
        let drafts = Drafts::default();
        let [older, other] = [7, u32::MAX].map(|tab| drafts.newest(tab));
        assert!(older().is_continue() && other().is_continue());
        let newer = drafts.newest(7);
        assert!(older().is_break());
        assert!(newer().is_continue() && other().is_continue());
    }
}
