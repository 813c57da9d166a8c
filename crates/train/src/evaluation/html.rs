//! The report as one HTML page that needs no other file: the text of `report.md`, with the figures in it.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use pulldown_cmark::{CowStr, Event, Options, Parser, Tag, html};

use super::EvaluationReport;
use super::figures::Figure;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse;display:block;overflow-x:auto;margin:1rem 0}\
th,td{border-bottom:1px solid #ddd;padding:.25rem .6rem;text-align:left}\
code{background:#f3f3f3;padding:0 .2em;overflow-wrap:anywhere}img{max-width:100%;height:auto;image-rendering:pixelated}";

/// The page. Figures whose file the report does not name are left out.
#[must_use]
pub fn html_page(report: &EvaluationReport, figures: &[Figure]) -> String {
    let markdown = report.to_markdown();
    let events = Parser::new_ext(&markdown, Options::ENABLE_TABLES).map(|event| match event {
        // The report has no markup of its own; a name with some is shown as it is.
        Event::Html(text) | Event::InlineHtml(text) => Event::Text(text),
        Event::Start(Tag::Image {
            link_type,
            dest_url,
            title,
            id,
        }) => Event::Start(Tag::Image {
            link_type,
            dest_url: data_url(&dest_url, figures),
            title,
            id,
        }),
        other => other,
    });
    let mut page = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n<meta name=\"viewport\" \
         content=\"width=device-width\">\n<title>Evaluation of {}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n",
        report.stamp.model
    );
    html::push_html(&mut page, events);
    let _ = page.write_str("</body>\n</html>\n");
    page
}

/// The figure of that file as a `data:` URL; the name itself where there is none.
fn data_url<'a>(file: &CowStr<'a>, figures: &[Figure]) -> CowStr<'a> {
    let Some(figure) = figures.iter().find(|figure| figure.about.file == **file) else {
        return file.clone();
    };
    let kind = match file.rsplit('.').next() {
        Some("svg") => "svg+xml",
        Some("gif") => "gif",
        _ => "png",
    };
    format!("data:image/{kind};base64,{}", STANDARD.encode(&figure.bytes)).into()
}
