//! The bytes of a MAT-file of level 5 (`save -v6`, `save -v7`, `scipy.io.savemat`), compressed or not, of either byte order.
//!
//! A data element is a tag (type, length) and its bytes, padded to 8. A matrix is an element that holds elements: flags with the class, dimensions,
//! name, and what the class asks for. Nothing is allocated that the file has no bytes for.
//!
//! Source: MathWorks, MAT-File Format, ch. 1, Level 5 MAT-Files.

use std::io::Read;

use flate2::read::ZlibDecoder;

use super::{Mat, NUMBER, VALUE};
use twin::limits::{Budget, DEPTH, Exceeded, MEMORY, TEXT};

/// Length of the text and of the version at the beginning.
const HEADER: usize = 128;
type Found<T> = Result<T, String>;

/// Variables by name.
pub(super) fn variables(bytes: &[u8]) -> Found<Vec<(String, Mat)>> {
    let header = bytes.get(..HEADER).ok_or("cut off within its first 128 bytes")?;
    let is_little = match &header[126..] {
        b"IM" => true,
        b"MI" => false,
        _ => return Err("no mark of the byte order at byte 126: not a MAT-file of level 5".into()),
    };
    let memory = Budget::new(MEMORY);
    let form = Form { is_little, memory: &memory };
    let mut reader = Reader { bytes: &bytes[HEADER..], form };
    let mut found = Vec::new();
    while !reader.bytes.is_empty() {
        let element = reader.element()?;
        let name_and_value = match element.kind {
            Kind::Matrix => element.matrix(form, 0),
            Kind::Compressed => inflate(element.bytes, &memory)
                .and_then(|inflated| Reader { bytes: &inflated, form }.element().and_then(|one| one.matrix(form, 0))),
            other => Err(format!("expected a variable, found an element of type {other:?}")),
        };
        let (name, value) = name_and_value.map_err(|problem| format!("variable {}: {problem}", found.len() + 1))?;
        if !name.is_empty() {
            found.push((name, value));
        }
    }
    Ok(found)
}

fn inflate(bytes: &[u8], memory: &Budget) -> Found<Vec<u8>> {
    let mut inflated = Vec::new();
    let mut decoder = ZlibDecoder::new(bytes).take(memory.left() + 1);
    decoder.read_to_end(&mut inflated).map_err(|error| format!("compressed: {error}"))?;
    memory.take(inflated.len() as u64).map_err(words)?;
    Ok(inflated)
}

fn words(exceeded: Exceeded) -> String {
    exceeded.to_string()
}

/// Types of elements.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Int8,
    UInt8,
    Int16,
    UInt16,
    Int32,
    UInt32,
    Single,
    Double,
    Int64,
    UInt64,
    Matrix,
    Compressed,
    Utf8,
    Utf16,
    Utf32,
}

impl Kind {
    fn of(number: u32) -> Found<Self> {
        Ok(match number {
            1 => Self::Int8,
            2 => Self::UInt8,
            3 => Self::Int16,
            4 => Self::UInt16,
            5 => Self::Int32,
            6 => Self::UInt32,
            7 => Self::Single,
            9 => Self::Double,
            12 => Self::Int64,
            13 => Self::UInt64,
            14 => Self::Matrix,
            15 => Self::Compressed,
            16 => Self::Utf8,
            17 => Self::Utf16,
            18 => Self::Utf32,
            _ => return Err(format!("no element is of type {number}")),
        })
    }
}

/// How a file is read: the order of its bytes, and the memory that its values may take.
#[derive(Debug, Clone, Copy)]
struct Form<'a> {
    is_little: bool,
    memory: &'a Budget,
}

/// What is left of an element's bytes.
#[derive(Debug, Clone, Copy)]
struct Reader<'a> {
    bytes: &'a [u8],
    form: Form<'a>,
}

/// An element: its type and its bytes.
#[derive(Debug, Clone, Copy)]
struct Element<'a> {
    kind: Kind,
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    fn take(&mut self, count: usize) -> Found<&'a [u8]> {
        let problem = || format!("cut off: {count} bytes stated, {} left", self.bytes.len());
        let (taken, rest) = self.bytes.split_at_checked(count).ok_or_else(problem)?;
        self.bytes = rest;
        Ok(taken)
    }

    fn word(&mut self) -> Found<u32> {
        let bytes = self.take(4)?.try_into().expect("four were taken");
        Ok(if self.form.is_little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    fn element(&mut self) -> Found<Element<'a>> {
        let first = self.word()?;
        // up to four bytes stand in the tag itself, their number in its upper half
        if first >> 16 != 0 {
            let (count, kind) = ((first >> 16) as usize, Kind::of(first & 0xffff)?);
            let bytes = self.take(4)?.get(..count).ok_or_else(|| format!("{count} bytes within a tag of 4"))?;
            return Ok(Element { kind, bytes });
        }
        let kind = Kind::of(first)?;
        let count = self.word()? as usize;
        // Octave counts up to seven bytes too many for characters, at the end of a compressed variable
        let is_long = kind == Kind::Matrix && (1..8).contains(&count.saturating_sub(self.bytes.len()));
        let bytes = self.take(if is_long { self.bytes.len() } else { count })?;
        if kind != Kind::Compressed {
            // the last one may lack its padding
            self.bytes = &self.bytes[(count.wrapping_neg() % 8).min(self.bytes.len())..];
        }
        Ok(Element { kind, bytes })
    }
}

impl<'a> Element<'a> {
    fn matrix(self, form: Form<'a>, depth: u64) -> Found<(String, Mat)> {
        match self.kind {
            Kind::Matrix => matrix(Reader { bytes: self.bytes, form }, depth),
            other => Err(format!("expected a matrix, found an element of type {other:?}")),
        }
    }

    fn numbers(self, Form { is_little, memory }: Form) -> Found<Vec<f64>> {
        macro_rules! all {
            ($number:ty) => {{
                memory.take(NUMBER * (self.bytes.len() / size_of::<$number>()) as u64).map_err(words)?;
                self.bytes
                    .chunks_exact(size_of::<$number>())
                    .map(|one| {
                        let one = one.try_into().expect("a chunk of its size");
                        (if is_little { <$number>::from_le_bytes(one) } else { <$number>::from_be_bytes(one) }) as f64
                    })
                    .collect()
            }};
        }
        Ok(match self.kind {
            Kind::Int8 => all!(i8),
            Kind::UInt8 | Kind::Utf8 => all!(u8),
            Kind::Int16 => all!(i16),
            Kind::UInt16 | Kind::Utf16 => all!(u16),
            Kind::Int32 => all!(i32),
            Kind::UInt32 | Kind::Utf32 => all!(u32),
            Kind::Single => all!(f32),
            Kind::Double => all!(f64),
            Kind::Int64 => all!(i64),
            Kind::UInt64 => all!(u64),
            other => return Err(format!("expected numbers, found an element of type {other:?}")),
        })
    }

    fn name(self) -> String {
        self.bytes.iter().take_while(|byte| **byte != 0).map(|byte| char::from(*byte)).collect()
    }
}

/// A matrix of any class, and its name.
fn matrix(mut reader: Reader, depth: u64) -> Found<(String, Mat)> {
    DEPTH.check(depth).and_then(|()| reader.form.memory.take(VALUE)).map_err(words)?;
    if reader.bytes.is_empty() {
        return Ok((String::new(), Mat::Numbers(vec![0, 0], Vec::new())));
    }
    let flags = reader.element()?.numbers(reader.form)?;
    let flags = *flags.first().ok_or("a matrix without flags")? as u32;
    let class = flags & 0xff;
    if class == 17 {
        return Ok((reader.element()?.name(), Mat::Other("object")));
    }
    let shape = shape(reader.element()?.numbers(reader.form)?)?;
    let name = reader.element()?.name();
    TEXT.check(name.len() as u64).map_err(words)?;
    let in_name = |problem: String| if name.is_empty() { problem } else { format!("{name}: {problem}") };
    let value = contents(&mut reader, class, shape, depth).map_err(in_name)?;
    Ok((name, value))
}

fn contents(reader: &mut Reader, class: u32, shape: Vec<usize>, depth: u64) -> Found<Mat> {
    match class {
        1 => cells(reader, shape, depth),
        2 => structs(reader, shape, depth),
        3 => {
            reader.element()?; // the name of the class of an object
            structs(reader, shape, depth)
        }
        4 => text(reader, &shape),
        5 => Ok(Mat::Other("sparse matrix")),
        6..=15 => {
            let values = reader.element()?.numbers(reader.form)?;
            let count: usize = shape.iter().product();
            match values.len() {
                found if found == count => Ok(Mat::Numbers(shape, values)),
                found => Err(format!("{count} numbers by its dimensions, {found} by its bytes")),
            }
        }
        16 => Ok(Mat::Other("function handle")),
        _ => Err(format!("no matrix is of class {class}")),
    }
}

/// Dimensions whose product can be counted.
fn shape(stated: Vec<f64>) -> Found<Vec<usize>> {
    let shape: Vec<usize> = stated.iter().map(|one| *one as usize).collect();
    let count = shape.iter().try_fold(1_usize, |all, one| all.checked_mul(*one));
    match count {
        Some(_) if shape.len() >= 2 && stated.iter().all(|one| *one >= 0.0) => Ok(shape),
        _ => Err(format!("dimensions {stated:?}")),
    }
}

fn cells(reader: &mut Reader, shape: Vec<usize>, depth: u64) -> Found<Mat> {
    let count: usize = shape.iter().product();
    let values = (0..count).map(|_| Ok(reader.element()?.matrix(reader.form, depth + 1)?.1));
    Ok(Mat::Cells(shape, values.collect::<Found<_>>()?))
}

fn structs(reader: &mut Reader, shape: Vec<usize>, depth: u64) -> Found<Mat> {
    let width = reader.element()?.numbers(reader.form)?;
    let width = width.first().map_or(0, |width| *width as usize);
    let names = reader.element()?;
    let count = names.bytes.len() / width.max(1);
    reader.form.memory.take((count * size_of::<String>() + names.bytes.len()) as u64).map_err(words)?;
    let names: Vec<String> = match width {
        0 => Vec::new(),
        width => names.bytes.chunks_exact(width).map(|bytes| Element { bytes, ..names }.name()).collect(),
    };
    if names.is_empty() {
        return Ok(Mat::Structs(shape, names, Vec::new()));
    }
    let count: usize = shape.iter().product();
    let one = |reader: &mut Reader| {
        let fields = names.iter().map(|name| {
            let value = reader.element().and_then(|one| one.matrix(reader.form, depth + 1));
            Ok(value.map_err(|problem| format!("{name}: {problem}"))?.1)
        });
        fields.collect::<Found<Vec<Mat>>>()
    };
    let values = (0..count).map(|_| one(reader)).collect::<Found<_>>()?;
    Ok(Mat::Structs(shape, names, values))
}

/// Characters, read across the lines of a matrix of them.
fn text(reader: &mut Reader, shape: &[usize]) -> Found<Mat> {
    let element = reader.element()?;
    reader.form.memory.take((element.bytes.len() * size_of::<char>()) as u64).map_err(words)?;
    let characters: Vec<char> = match element.kind {
        Kind::Utf8 => String::from_utf8_lossy(element.bytes).chars().collect(),
        _ => {
            let codes = element.numbers(reader.form)?.into_iter().map(|one| one as u16);
            char::decode_utf16(codes).map(|one| one.unwrap_or(char::REPLACEMENT_CHARACTER)).collect()
        }
    };
    let rows = shape[0].max(1);
    Ok(Mat::Text((0..rows.min(characters.len())).flat_map(|row| characters.iter().skip(row).step_by(rows)).collect()))
}
