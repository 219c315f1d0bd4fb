//! Tables and keys by the names that they had before.
use super::Config;
use crate::error::ConfigError;

/// Earlier names and those that took their place; keys before the table that they stand in.
const RENAMED: [(&str, &str); 5] = [
    ("optimize.light", "light.recover_light"),
    ("optimize.tone", "light.recover_tone"),
    ("optimize", "light"),
    ("light.light", "light.recover_light"),
    ("light.tone", "light.recover_tone"),
];

/// The present name of `name` (a table, a dotted key or a stage), if it was renamed.
pub fn renamed(name: &str) -> Option<&'static str> {
    let found = RENAMED.iter().find(|(old, _)| *old == name);
    found.map(|(_, new)| *new)
}

/// Refuses a configuration that uses an earlier name, and says the one that took its place.
pub(super) fn check(config: &Config) -> Result<(), ConfigError> {
    for (old, new) in RENAMED {
        if let Some(at) = config.place(old) {
            let named = |name: &str| match name.contains('.') {
                true => name.to_string(),
                false => format!("[{name}]"),
            };
            return Err(ConfigError::Renamed {
                at,
                old: named(old),
                new: named(new),
            });
        }
    }
    Ok(())
}
