//! A document of any format that serde reads, no deeper and no larger than the limits.

use core::fmt;

use serde::de::{Deserialize, DeserializeOwned, DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};
use serde_json::{Map, Number, Value};

use super::{Budget, DEPTH, Exceeded, FINITE, MEMORY, TEXT};

/// The values of a document; a number that is not finite is null, as it is in JSON.
#[derive(Debug, Clone, PartialEq)]
pub struct Document(pub Value);

impl<'de> Deserialize<'de> for Document {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        Bounded { memory: &Budget::new(MEMORY), depth: 0 }.deserialize(from).map(Self)
    }
}

/// JSON of our own as a type: a document whose numbers are within [`FINITE`].
///
/// # Errors
/// Where it is none, by serde_json; the path of a number.
pub fn json<T: DeserializeOwned>(text: &str) -> serde_json::Result<T> {
    let Document(value) = serde_json::from_str(text)?;
    check(&value).map_err(serde_json::Error::custom)?;
    serde_json::from_str(text)
}

fn check(value: &Value) -> Result<(), String> {
    match value {
        Value::Number(number) if number.is_f64() => FINITE.check(number.as_f64().unwrap_or(f64::NAN)).map(drop),
        Value::Array(all) => {
            let each = |(at, value)| check(value).map_err(|problem| format!("entry {}: {problem}", at + 1));
            all.iter().enumerate().try_for_each(each)
        }
        Value::Object(all) => {
            all.iter().try_for_each(|(name, value)| check(value).map_err(|problem| format!("{name}: {problem}")))
        }
        _ => Ok(()),
    }
}

/// A value within so many others.
#[derive(Clone, Copy)]
struct Bounded<'b> {
    memory: &'b Budget,
    depth: u64,
}

/// What a value takes beside its text [B].
const VALUE: u64 = size_of::<Value>() as u64;
/// Entries that a node of a map holds at least when it is split, and what the node takes [B].
const ENTRIES: usize = 6;
const NODE: u64 = 640;
/// How serde_json hands over a number where a dependency has it keep all digits.
const DIGITS: &str = "$serde_json::private::Number";

impl Bounded<'_> {
    fn take<E: Error>(self, bytes: u64) -> Result<(), E> {
        self.memory.take(bytes).map_err(refused)
    }

    fn within<E: Error>(self) -> Result<Self, E> {
        DEPTH.check(self.depth + 1).map_err(refused)?;
        Ok(Self { depth: self.depth + 1, ..self })
    }

    fn check_text<E: Error>(self, text: &str) -> Result<(), E> {
        TEXT.check(text.len() as u64).map_err(refused)?;
        self.take(text.len() as u64)
    }
}

fn refused<E: Error>(exceeded: Exceeded) -> E {
    E::custom(exceeded)
}

impl<'de> DeserializeSeed<'de> for Bounded<'_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, from: D) -> Result<Value, D::Error> {
        self.take(VALUE)?;
        from.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Bounded<'_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_none<E: Error>(self) -> Result<Value, E> {
        Ok(Value::Null)
    }

    fn visit_some<D: Deserializer<'de>>(self, from: D) -> Result<Value, D::Error> {
        from.deserialize_any(self)
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        Ok(value.into())
    }

    fn visit_i128<E: Error>(self, value: i128) -> Result<Value, E> {
        self.visit_f64(value as f64)
    }

    fn visit_u128<E: Error>(self, value: u128) -> Result<Value, E> {
        self.visit_f64(value as f64)
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        Ok(Number::from_f64(value).map_or(Value::Null, Value::Number))
    }

    fn visit_str<E: Error>(self, value: &str) -> Result<Value, E> {
        self.check_text(value)?;
        Ok(value.into())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Value, A::Error> {
        let inner = self.within()?;
        let mut values = Vec::new();
        while let Some(value) = list.next_element_seed(inner)? {
            // a list that grows has room for twice its values
            self.take(VALUE)?;
            values.push(value);
        }
        Ok(Value::Array(values))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Value, A::Error> {
        let inner = self.within()?;
        let mut map = Map::new();
        while let Some(name) = entries.next_key::<String>()? {
            if name == DIGITS {
                return entries.next_value::<String>()?.parse().map(Value::Number).map_err(A::Error::custom);
            }
            self.check_text(&name)?;
            if map.len().is_multiple_of(ENTRIES) {
                self.take(NODE)?;
            }
            map.insert(name, entries.next_value_seed(inner)?);
        }
        Ok(Value::Object(map))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(text: &str) -> String {
        serde_json::from_str::<Document>(text).unwrap_err().to_string()
    }

    #[test]
    fn a_document_has_the_values_that_serde_json_reads() {
        let text =
            r#"{"a": [1, -2, 2.5e-3, 1e300, true, null, "text", {}, []], "b": {"c": {"d": 18446744073709551615}}}"#;
        assert_eq!(serde_json::from_str::<Document>(text).unwrap().0, serde_json::from_str::<Value>(text).unwrap());
    }

    #[test]
    fn a_number_that_is_too_large_is_said_with_its_path() {
        let said = json::<Value>(r#"{"elements": [{"length": 1}, {"length": -1e300}]}"#).unwrap_err().to_string();
        assert_eq!(said, "elements: entry 2: length: expected a number from -1e15 to 1e15, found -1e300");
        // numbers are not the objects that serde_json may hand over
        let many = format!("[{}0]", "0.5,".repeat(2_000_000));
        assert!(json::<Vec<f64>>(&many).is_ok());
        // a seed is no number of a measurement
        assert_eq!(json::<Vec<u64>>("[18446744073709551615]").unwrap(), [u64::MAX]);
    }

    #[test]
    fn what_is_too_deep_too_long_or_too_many_is_refused() {
        let deep = |levels| "[".repeat(levels) + &"]".repeat(levels);
        assert!(serde_json::from_str::<Document>(&deep(64)).is_ok());
        assert!(said(&deep(65)).starts_with("expected at most 64 levels within each other, found 65"));
        assert!(
            said(&format!("[{:?}]", "n".repeat(1 << 20 | 1))).starts_with("expected at most 1048576 bytes in a name")
        );
        let many = format!("[{}0]", "{\"a\":0},".repeat(400_000));
        assert!(said(&many).starts_with("expected at most 201326592 bytes in memory"));
    }
}
