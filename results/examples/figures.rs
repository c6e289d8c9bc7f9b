//! The page of a recording's diagnosis and its figures as files, such as those of `docs/diagnosis.md`:
//! `cargo run --release -p results --example figures -- recordings/concealed/open-10 docs/figures`.
//!
//! The first figure of each section is written as `RECORDING-SECTION.svg`, unless names of sections follow, then only of those; without any
//! the page is written too.

use core::error::Error;
use std::path::{Path, PathBuf};

use diagnosis::Diagnosis;
use inference::Recording;
use results::diagnosis_page;
use twin::Ring;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(recording), Some(folder)) = (arguments.next(), arguments.next().map(PathBuf::from)) else {
        return Err("usage: figures RECORDING FOLDER [SECTION...]".into());
    };
    let wanted: Vec<String> = arguments.collect();
    let ring = Ring::paper_booster();
    let recording = Recording::read(Path::new(&recording), &ring)?;
    let diagnosis = Diagnosis::from_recording(&ring, &recording, |_| ())?;
    let page = diagnosis_page(&diagnosis, &recording)?;
    for section in &page.sections {
        let name = section.heading.to_lowercase().replace(' ', "-");
        if let Some((_, figure)) = section.figures.first().filter(|_| wanted.is_empty() || wanted.contains(&name)) {
            std::fs::write(folder.join(format!("{}-{name}.svg", recording.name)), &figure.svg)?;
        }
    }
    if wanted.is_empty() {
        page.write(&folder.join(format!("{}.html", recording.name)))?;
    }
    Ok(())
}
