//! The ELF file: how it is built, where its functions lie, how much memory it takes.

use std::ffi::OsString;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use object::{File, Object, ObjectSection, ObjectSymbol, SectionFlags, SectionKind, SymbolKind, elf};

use super::Error;
use super::log::{self, Line};
use crate::repository;

/// Exception handlers that run whenever a byte comes or the clock ticks.
const HANDLERS: [&str; 2] = ["DefaultHandler", "SysTick"];

/// An image for the chip.
#[derive(Debug, Clone)]
pub struct Image {
    path: PathBuf,
    elf: Vec<u8>,
}

/// A function of the image: a region that can be counted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Function {
    /// The name it was asked for by.
    pub name: String,
    /// Where its code begins.
    pub address: u64,
    /// How long its code is [B].
    pub size: u64,
}

/// Memory that an image takes [B].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sizes {
    /// Vectors, code, constants and the initial values of statics.
    pub flash: u64,
    /// Statics; the stack comes on top.
    pub ram: u64,
}

impl Image {
    /// Build the image of a device by cargo, in the profile `firmware`.
    ///
    /// # Errors
    /// If cargo fails, for instance since the Cortex-M target is not installed.
    pub fn build() -> Result<Self, Error> {
        Self::build_of("firmware")
    }

    /// The same of any program of `firmware-sim`.
    ///
    /// # Errors
    /// If cargo fails.
    pub fn build_of(program: &str) -> Result<Self, Error> {
        let cargo = std::env::var_os("CARGO").unwrap_or_else(|| OsString::from("cargo"));
        let build = ["build", "--locked", "--profile", "firmware", "--message-format", "json-render-diagnostics"];
        let what = ["--package", "firmware-sim", "--bin", program, "--target", "thumbv7em-none-eabihf"];
        let mut command = Command::new(cargo);
        command.args(build).args(what).current_dir(repository("."));
        let output = command.output().map_err(Error::starting("cargo"))?;
        Error::unless_successful("cargo", &output)?;
        Self::open(&executable(&output.stdout).ok_or_else(|| Error::Image("cargo built none".into()))?)
    }

    /// Read an image from a file.
    ///
    /// # Errors
    /// If it cannot be read, or is not an ELF file.
    pub fn open(path: &Path) -> Result<Self, Error> {
        let image = Self { path: path.into(), elf: fs::read(path).map_err(Error::file(path))? };
        image.object().map(|_| ())?;
        Ok(image)
    }

    /// The ELF file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The one function whose path ends like this: `ingest`, `Estimator::ingest`.
    ///
    /// Generic arguments stand as `_` in it: `Estimator<_,_>::ingest` is also found as `Estimator::ingest`.
    ///
    /// # Errors
    /// If there is no such function, or several.
    pub fn function(&self, name: &str) -> Result<Function, Error> {
        let mut found = self.functions()?;
        found.retain(|f| ends_with_path(&f.name, name));
        match found.as_slice() {
            [one] => Ok(Function { name: name.into(), ..*one }),
            _ => Err(Error::Function { name: name.into(), found: found.into_iter().map(|f| f.name).collect() }),
        }
    }

    /// The same image, written to `path`, with other code at the beginning of a function.
    ///
    /// # Errors
    /// If the function is not in the file, or the file cannot be written.
    pub fn patched(&self, function: &Function, code: &[u8], path: &Path) -> Result<Self, Error> {
        let address = function.address & !1; // the lowest bit says Thumb
        let object = self.object()?;
        let place = object.sections().find_map(|section| {
            let (start, _) = section.file_range()?;
            let within = address.checked_sub(section.address()).filter(|within| *within < section.size())?;
            usize::try_from(start + within).ok()
        });
        let mut elf = self.elf.clone();
        let place = place.and_then(|place| elf.get_mut(place..place + code.len()));
        place.ok_or_else(|| Error::Image(format!("{} is not in the file", function.name)))?.copy_from_slice(code);
        fs::write(path, &elf).map_err(Error::file(path))?;
        Self::open(path)
    }

    /// Flash and static RAM.
    ///
    /// # Errors
    /// If the file cannot be read as ELF.
    pub fn sizes(&self) -> Result<Sizes, Error> {
        let object = self.object()?;
        let mut sizes = Sizes { flash: 0, ram: 0 };
        for section in object.sections().filter(is_loaded) {
            let (initialised, in_ram) = match section.kind() {
                SectionKind::UninitializedData => (false, true),
                SectionKind::Data => (true, true),
                _ => (true, false),
            };
            sizes.flash += if initialised { section.size() } else { 0 };
            sizes.ram += if in_ram { section.size() } else { 0 };
        }
        Ok(sizes)
    }

    /// Log lines from what the image wrote to the emulator's standard output.
    ///
    /// # Errors
    /// If the image has no log, or the bytes are not its own.
    pub fn log(&self, stdout: &[u8]) -> Result<Vec<Line>, Error> {
        log::decode(&self.elf, stdout)
    }

    /// The functions that run by interrupt: the handlers of the vector table, and what the compiler left of their bodies.
    pub(super) fn handlers(&self) -> Result<Vec<Function>, Error> {
        let mut functions = self.functions()?;
        functions.retain(|f| HANDLERS.iter().any(|handler| f.name.ends_with(handler)));
        Ok(functions)
    }

    fn functions(&self) -> Result<Vec<Function>, Error> {
        let object = self.object()?;
        let code = object.symbols().filter(|s| s.kind() == SymbolKind::Text && s.size() > 0);
        Ok(code
            .filter_map(|s| Some(Function { name: readable(s.name().ok()?), address: s.address(), size: s.size() }))
            .collect())
    }

    fn object(&self) -> Result<File<'_>, Error> {
        File::parse(self.elf.as_slice()).map_err(|error| Error::Image(error.to_string()))
    }
}

/// The executable that cargo's messages name.
fn executable(messages: &[u8]) -> Option<PathBuf> {
    let mut messages = messages.split(|&b| b == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
    messages.find_map(|m: serde_json::Value| m["executable"].as_str().map(PathBuf::from))
}

/// The name without mangling, hash and generic arguments.
fn readable(symbol: &str) -> String {
    let name = format!("{:#}", rustc_demangle::demangle(symbol));
    let mut depth = 0;
    let outside = |c: &char| {
        depth += i32::from(*c == '<');
        let keep = depth == 0;
        depth -= i32::from(*c == '>');
        keep
    };
    if name.starts_with('<') { name } else { name.chars().filter(outside).collect() }
}

fn ends_with_path(name: &str, path: &str) -> bool {
    name.strip_suffix(path).is_some_and(|before| before.is_empty() || before.ends_with("::"))
}

fn is_loaded<'data>(section: &impl ObjectSection<'data>) -> bool {
    matches!(section.flags(), SectionFlags::Elf { sh_flags } if sh_flags & u64::from(elf::SHF_ALLOC) != 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_function_is_named_by_the_end_of_its_path() {
        let name = readable("_ZN9estimator9estimator26Estimator$LT$_$C$_$C$_$GT$6ingest17h0123456789abcdefE");
        assert_eq!(name, "estimator::estimator::Estimator::ingest");
        assert!(ends_with_path(&name, "ingest") && ends_with_path(&name, "Estimator::ingest"));
        assert!(!ends_with_path(&name, "gest"), "part of a word");
    }
}
