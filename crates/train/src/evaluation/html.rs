//! The report as one HTML page that needs no other file: the text of `report.md`, with the figures in it.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use pulldown_cmark::{CowStr, Event, HeadingLevel, Options, Parser, Tag, TagEnd, html};

use super::EvaluationReport;
use super::figures::Figure;

const STYLE: &str = "body{font:15px/1.5 system-ui,sans-serif;max-width:75rem;margin:2rem auto;padding:0 1rem;color:#222}\
table{border-collapse:collapse;display:block;overflow-x:auto;margin:1rem 0}\
th,td{border-bottom:1px solid #ddd;padding:.25rem .6rem;text-align:left}\
code{background:#f3f3f3;padding:0 .2em;overflow-wrap:anywhere}img{max-width:100%;height:auto;image-rendering:pixelated}\
details{border-top:1px solid #ddd}summary{cursor:pointer}summary h2{display:inline-block;margin:.6rem 0}";

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
    html::push_html(&mut page, folded(events));
    let _ = page.write_str("</body>\n</html>\n");
    page
}

/// Each section of the report can be folded. The first one is open: with what stands before it, it is the summary.
fn folded<'a>(events: impl Iterator<Item = Event<'a>>) -> impl Iterator<Item = Event<'a>> {
    let mut sections = 0;
    let sections_and_end = events.map(Some).chain([None]);
    sections_and_end.flat_map(move |event| {
        let markup = |text: &'static str| Some(Event::Html(text.into()));
        match event {
            Some(Event::Start(Tag::Heading {
                level: HeadingLevel::H2,
                ..
            })) => {
                sections += 1;
                let begin = match sections {
                    1 => "<details open>\n<summary>",
                    _ => "</details>\n<details>\n<summary>",
                };
                [markup(begin), event]
            }
            Some(Event::End(TagEnd::Heading(HeadingLevel::H2))) => [event, markup("</summary>\n")],
            None if sections > 0 => [markup("</details>\n"), None],
            _ => [event, None],
        }
        .into_iter()
        .flatten()
    })
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
