//! HTML pages that are complete in themselves: pictures are part of the file.
use std::path::Path;

use anyhow::Context;
use base64::prelude::{BASE64_STANDARD, Engine};
use dipir_stages::report::html::Html;

const STYLE: &str = include_str!("style.css");

/// A page that is being put together.
pub struct Page {
    html: String,
}

impl Page {
    /// A page called `title`.
    pub fn new(title: &str) -> Self {
        let title = text(title);
        Self {
            html: format!(
                "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
                 <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
                 <title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>\n"
            ),
        }
    }

    /// Adds markup; what is not the program's own must have gone through [`text`].
    pub fn push(&mut self, markup: &str) {
        self.html += markup;
        self.html.push('\n');
    }

    /// The whole page.
    pub fn finish(self) -> String {
        self.html + "</body></html>\n"
    }
}

/// Text with `&`, `<` and the like escaped, for elements and attributes.
pub fn text(text: &str) -> String {
    Html::text(text).into_string()
}

/// JSON for a script: what would end the script's element is escaped.
pub fn json(value: &impl serde::Serialize) -> anyhow::Result<String> {
    Ok(serde_json::to_string(value)?.replace('<', "\\u003c"))
}

/// The PNG file as an image.
pub fn image(path: &Path, alt: &str) -> anyhow::Result<String> {
    Ok(format!(
        "<img src=\"{}\" alt=\"{}\">",
        address(path)?,
        text(alt)
    ))
}

/// The PNG file as an address.
pub fn address(path: &Path) -> anyhow::Result<String> {
    let bytes =
        dipir_files::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(format!(
        "data:image/png;base64,{}",
        BASE64_STANDARD.encode(bytes)
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_is_put_in_becomes_markup() {
        assert_eq!(text("<b \"'&>"), "&lt;b &quot;&#39;&amp;&gt;");
        assert_eq!(json(&"</script>").unwrap(), "\"\\u003c/script>\"");
    }

    #[test]
    fn a_picture_that_is_no_regular_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let message = format!("{:#}", address(folder.path()).unwrap_err());
        assert!(message.ends_with("not a regular file"), "{message}");
    }
}
