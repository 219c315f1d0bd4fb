//! HTML in which every string is escaped: text and attributes go in as text, and only what this
//! module put together is markup.
use std::fmt::Write;

use base64::prelude::{BASE64_STANDARD, Engine};
use dipir_plotting::chart::Chart;

/// Finished markup.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Html(String);

/// Elements without content and end tag.
const VOID: [&str; 5] = ["img", "input", "meta", "br", "link"];

impl Html {
    /// Text, escaped.
    pub fn text(text: impl AsRef<str>) -> Self {
        let mut html = String::new();
        escape(text.as_ref(), &mut html);
        Self(html)
    }

    /// `<tag name="value" …>children</tag>`. Tags and names of attributes are the program's own;
    /// values are escaped.
    pub fn element(
        tag: &'static str,
        attributes: &[(&'static str, &str)],
        children: impl IntoIterator<Item = Html>,
    ) -> Self {
        let mut html = format!("<{tag}");
        for (name, value) in attributes {
            let _ = write!(html, " {name}=\"");
            escape(value, &mut html);
            html.push('"');
        }
        html.push('>');
        if !VOID.contains(&tag) {
            children.into_iter().for_each(|child| html += &child.0);
            let _ = write!(html, "</{tag}>");
        }
        Self(html)
    }

    /// An element with text and no attributes.
    pub fn of(tag: &'static str, text: impl AsRef<str>) -> Self {
        Self::element(tag, &[], [Self::text(text)])
    }

    /// The program's own style sheet or script, which must not hold `</`.
    pub fn code(tag: &'static str, code: &'static str) -> Self {
        assert!(!code.contains("</"), "{tag}");
        Self(format!("<{tag}>{code}</{tag}>"))
    }

    /// A chart under its title, with its numbers as a CSV file; nothing if there are no two points
    /// to draw.
    pub fn chart(title: &str, chart: &Chart) -> Option<Self> {
        if chart.visible_points() < 2 {
            return None;
        }
        let numbers = BASE64_STANDARD.encode(chart.to_csv());
        let address = format!("data:text/csv;base64,{numbers}");
        let name = title.split([':', ',']).next().unwrap_or(title);
        let file = format!("{}.csv", name.to_lowercase().replace(' ', "-"));
        let link = [("href", address.as_str()), ("download", file.as_str())];
        let caption = [
            Self::text(format!("{title} ")),
            Self::element("a", &link, [Self::text("CSV")]),
        ];
        let drawing = Self(chart.draw().to_inline_svg(title));
        let figure = [Self::element("figcaption", &[], caption), drawing];
        Some(Self::element("figure", &[("class", "plot")], figure))
    }

    /// One after the other.
    pub fn all(parts: impl IntoIterator<Item = Html>) -> Self {
        Self(parts.into_iter().map(|p| p.0).collect())
    }

    /// The markup.
    pub fn into_string(self) -> String {
        self.0
    }
}

fn escape(text: &str, html: &mut String) {
    for c in text.chars() {
        match c {
            '&' => html.push_str("&amp;"),
            '<' => html.push_str("&lt;"),
            '>' => html.push_str("&gt;"),
            '"' => html.push_str("&quot;"),
            '\'' => html.push_str("&#39;"),
            // Not allowed in HTML, whatever the escape.
            c if c.is_control() && !c.is_whitespace() => html.push('\u{fffd}'),
            c => html.push(c),
        }
    }
}

/// A table; columns whose head begins with `>` are aligned to the right. Every cell names its column,
/// which the style shows where the page is too narrow for columns.
pub fn table(heads: &[&str], rows: Vec<Vec<Html>>) -> Html {
    let class = |k: usize| match heads[k].starts_with('>') {
        true => "number",
        false => "",
    };
    let name = |k: usize| heads[k].trim_start_matches('>');
    let cell = |k: usize, content| {
        let attributes = [("class", class(k)), ("data-head", name(k))];
        Html::element("td", &attributes, [content])
    };
    let head = (0..heads.len())
        .map(|k| Html::element("th", &[("class", class(k))], [Html::text(name(k))]));
    let body = rows.into_iter().map(|row| {
        let cells = row.into_iter().enumerate();
        Html::element("tr", &[], cells.map(|(k, content)| cell(k, content)))
    });
    let head = Html::element("thead", &[], [Html::element("tr", &[], head)]);
    let table = Html::element("table", &[], [head, Html::element("tbody", &[], body)]);
    Html::element("div", &[("class", "wide")], [table])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whatever_is_put_in_stays_text() {
        let evil = "</td><script>alert('\"&')</script>\u{1}";
        let html = Html::element("td", &[("title", evil)], [Html::text(evil)]).into_string();
        let escaped =
            "&lt;/td&gt;&lt;script&gt;alert(&#39;&quot;&amp;&#39;)&lt;/script&gt;\u{fffd}";
        assert_eq!(html, format!("<td title=\"{escaped}\">{escaped}</td>"));
    }

    #[test]
    fn elements_without_content_have_no_end_tag() {
        let html = Html::element("img", &[("alt", "")], [Html::text("lost")]);
        assert_eq!(html.into_string(), "<img alt=\"\">");
    }

    #[test]
    fn a_table_aligns_numbers() {
        let rows = vec![vec![Html::text("a"), Html::text("1")]];
        let html = table(&["name", ">n"], rows).into_string();
        assert!(
            html.contains("<td class=\"number\" data-head=\"n\">1</td>"),
            "{html}"
        );
        assert!(html.contains("<th class=\"number\">n</th>"), "{html}");
    }
}
