//! The largest sizes of a network that its weights can fill. A configuration with larger ones is refused before a layer
//! is built.

/// How many tensors there are, and how long the longest of their axes is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extent {
    /// Number of tensors.
    pub tensors: usize,
    /// Length of the longest axis of any tensor that holds numbers.
    pub axis: usize,
}

impl Extent {
    /// Checks a number of layers, blocks or levels: each has at least one tensor.
    pub(crate) fn layers(&self, key: &str, value: usize) -> Result<(), String> {
        if (1..=self.tensors).contains(&value) {
            return Ok(());
        }
        Err(format!(
            "{key} = {value} does not fit the weights beside it, which hold {} tensors; accepted: 1 to the number \
             of layers in the weights",
            self.tensors
        ))
    }

    /// Checks a number of channels, tokens or states: each is the length of an axis.
    pub(crate) fn width(&self, key: &str, value: usize) -> Result<(), String> {
        if (1..=self.axis).contains(&value) {
            return Ok(());
        }
        Err(format!(
            "{key} = {value} does not fit the weights beside it, whose longest axis is {}; accepted: 1 to that",
            self.axis
        ))
    }
}
