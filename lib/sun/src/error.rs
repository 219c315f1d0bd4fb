//! Errors in what the configuration says of the sun.

/// A key with a value that makes no sense, or that cannot be used with what else is known.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SunError {
    /// A value outside its range or form.
    #[error("{key} is {value}; accepted: {accepted}")]
    Value {
        /// Dotted path of the key, `light.sun.elevation_deg`.
        key: String,
        /// The value as written.
        value: String,
        /// The accepted form, with an example.
        accepted: &'static str,
    },
    /// A key that another one needs.
    #[error("{key} is missing; {remedy}")]
    Missing {
        /// Dotted path of the key.
        key: String,
        /// What to write.
        remedy: &'static str,
    },
    /// Two keys say the same thing in two ways.
    #[error("{first} and {second} cannot both be given; keep one of them")]
    Conflict {
        /// Dotted path of the one key.
        first: String,
        /// Dotted path of the other key.
        second: String,
    },
}
