//! One HTML page with everything in it.

use core::fmt::Display;
use std::io::{self, Write};
use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::figure::Figure;

/// A report: a lead and sections, listed at the top.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Page {
    /// Title of the page.
    pub title: String,
    /// What the page says, in a few sentences.
    pub lead: String,
    /// Its parts, in order.
    pub sections: Vec<Section>,
}

/// A part of a page: paragraphs, then figures, then tables.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Section {
    /// Heading, also in the list at the top.
    pub heading: String,
    /// Paragraphs of plain text.
    pub text: Vec<String>,
    /// Captions and figures.
    pub figures: Vec<(String, Figure)>,
    /// Tables.
    pub tables: Vec<Table>,
}

/// A table of texts; cells that begin like a number stand to the right.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Table {
    /// What it holds.
    pub caption: String,
    /// Heads of the columns, with units.
    pub header: Vec<String>,
    /// Rows of cells.
    pub rows: Vec<Vec<String>>,
}

impl Page {
    /// The page as one HTML document.
    pub fn render(&self) -> String {
        let mut count = Count::default();
        let sections = self.sections.iter().enumerate().map(|(index, section)| section.render(index + 1, &mut count));
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    title { (self.title) }
                    style { (PreEscaped(include_str!("page.css"))) }
                }
                body {
                    h1 { (self.title) }
                    p.lead { (self.lead) }
                    (self.contents())
                    @for section in sections { (section) }
                }
            }
        };
        page.into_string()
    }

    /// Writes the page, whole or not at all.
    ///
    /// # Errors
    /// When the folder is missing, full or closed to us.
    pub fn write(&self, path: &Path) -> io::Result<()> {
        let mut file = temporary(path)?;
        file.write_all(self.render().as_bytes())?;
        file.persist(path)?;
        Ok(())
    }

    fn contents(&self) -> Markup {
        html! {
            nav aria-label="Contents" {
                ol {
                    @for (index, section) in self.sections.iter().enumerate() {
                        li { a href=(format!("#section-{}", index + 1)) { (section.heading) } }
                    }
                }
            }
        }
    }
}

/// A temporary file beside its final place, with the permissions that a created file has.
fn temporary(path: &Path) -> io::Result<tempfile::NamedTempFile> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666)); // less the umask, as open(2) does
    }
    builder.tempfile_in(folder)
}

/// Figures and tables so far: they are numbered through the whole page.
#[derive(Default)]
struct Count {
    figures: usize,
    tables: usize,
}

impl Section {
    fn render(&self, number: usize, count: &mut Count) -> Markup {
        let figures = self.figures.iter().map(|(caption, figure)| {
            count.figures += 1;
            numbered_figure(count.figures, caption, figure)
        });
        let tables = self.tables.iter().map(|table| {
            count.tables += 1;
            table.render(count.tables)
        });
        html! {
            section id=(format!("section-{number}")) {
                h2 { (number) ". " (self.heading) }
                @for paragraph in &self.text { p { (paragraph) } }
                @for figure in figures { (figure) }
                @for table in tables { (table) }
            }
        }
    }
}

fn numbered_figure(number: usize, caption: &str, figure: &Figure) -> Markup {
    let data = format!("data:text/csv;base64,{}", BASE64_STANDARD.encode(&figure.csv));
    html! {
        figure id=(format!("figure-{number}")) {
            @match &figure.narrow {
                Some(narrow) => {
                    div.wide { (PreEscaped(&figure.svg)) }
                    div.narrow aria-hidden="true" { (PreEscaped(narrow)) }
                }
                None => div.scroll { (PreEscaped(&figure.svg)) }
            }
            figcaption {
                (head("Figure", number)) (caption) " "
                a.numbers href=(data) download=(format!("figure-{number}.csv")) { "numbers (CSV)" }
            }
        }
    }
}

impl Table {
    fn render(&self, number: usize) -> Markup {
        html! {
            div.table id=(format!("table-{number}")) {
                p.caption id=(format!("table-{number}-caption")) { (head("Table", number)) (self.caption) }
                div.scroll {
                    table aria-labelledby=(format!("table-{number}-caption")) {
                        thead { tr { @for (column, cell) in self.header.iter().enumerate() { th.number[self.counts(column)] { (cell) } } } }
                        tbody {
                            @for row in &self.rows {
                                tr { @for cell in row { td.number[is_number(cell)] { (cell) } } }
                            }
                        }
                    }
                }
            }
        }
    }

    /// Whether a column holds numbers, judged by its first cell.
    fn counts(&self, column: usize) -> bool {
        self.rows.first().and_then(|row| row.get(column)).is_some_and(|cell| is_number(cell))
    }
}

fn head(kind: &str, number: impl Display) -> Markup {
    html! { b { (kind) " " (number) "." } " " }
}

/// Whether a cell begins like a number.
fn is_number(cell: &str) -> bool {
    cell.trim_start_matches(['-', '+', '\u{2212}']).starts_with(|first: char| first.is_ascii_digit())
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::{Axes, Series};

    fn page() -> Page {
        let line = Series::line("a < b", vec![0.0, 1.0], vec![0.0, 1.0]);
        let figure = Figure::lines(&Axes::new("x < y & z", "x", "y"), &[line]);
        let table = Table { caption: "cells".into(), header: vec!["a".into()], rows: vec![vec!["1 < 2".into()]] };
        let section = Section {
            heading: "One <b>".into(),
            text: vec!["p < 0.05".into()],
            figures: vec![("caption <".into(), figure.clone()), ("again".into(), figure)],
            tables: vec![table.clone(), table],
        };
        Page { title: "T < U".into(), lead: "lead <".into(), sections: vec![section.clone(), section] }
    }

    fn values<'a>(html: &'a str, attribute: &str) -> Vec<&'a str> {
        let starts = html.split(attribute).skip(1);
        starts.map(|rest| rest.split('"').next().expect("a split has a first part")).collect()
    }

    #[test]
    fn texts_are_escaped() {
        let html = page().render();
        assert!(!html.contains(" < "), "an escaped text holds no bare angle bracket");
        assert!(html.contains("<h2>1. One &lt;b&gt;</h2>"));
        assert!(html.contains("x &lt; y &amp; z"));
    }

    #[test]
    fn nothing_is_fetched_and_nothing_runs() {
        let html = page().render().replace("xmlns=\"http://www.w3.org/2000/svg\"", "");
        for word in ["http", "<script", "url(", "@import", "src="] {
            assert!(!html.contains(word), "{word}");
        }
    }

    #[test]
    fn ids_are_unique_and_the_contents_lead_to_them() {
        let html = page().render();
        let ids = values(&html, " id=\"");
        let unique: HashSet<_> = ids.iter().collect();
        assert_eq!(unique.len(), ids.len(), "{ids:?}");
        let targets = values(&html, "href=\"#");
        assert_eq!(targets, ["section-1", "section-2"]);
        assert!(targets.iter().all(|target| unique.contains(target)));
    }

    #[test]
    fn every_figure_carries_its_numbers() {
        let html = page().render();
        let data = values(&html, "href=\"data:text/csv;base64,");
        let csv = BASE64_STANDARD.decode(data[0]).expect("a link that was just encoded");
        assert_eq!(data.len(), 4);
        assert_eq!(csv, page().sections[0].figures[0].1.csv.as_bytes());
    }

    #[test]
    fn a_phone_has_drawings_and_tables_of_its_own_width() {
        let html = page().render();
        assert_eq!(html.matches("<div class=\"narrow\"").count(), 4);
        assert_eq!(html.matches("<div class=\"scroll\"><table").count(), 4);
        let css = include_str!("page.css");
        assert!(css.contains("@media screen and (max-width: 700px)") && css.contains("@media print"));
    }

    #[test]
    fn a_page_is_written_whole_over_an_old_one() {
        let folder = tempfile::tempdir().expect("a folder for the test");
        let path = folder.path().join("report.html");
        std::fs::write(&path, "old").expect("a file in it");
        page().write(&path).expect("a page in it");
        assert_eq!(std::fs::read_to_string(&path).expect("the page"), page().render());
        assert_eq!(std::fs::read_dir(folder.path()).expect("the folder").count(), 1, "nothing else is left");
    }
}
