//! No number of a result is NaN or infinite: JSON has none of them, and `null` would be no number. A field that would be one is left out,
//! and `absent` says which, and what was found: `"absent": {"nuts.rhat_max": "NaN"}`.

use core::cell::RefCell;
use core::fmt::Display;
use std::collections::BTreeMap;

use serde::Serialize;
use serde::ser::{self, Error as _};
use serde_json::{Error, Value};

/// The JSON of a value, its fields in their order.
///
/// # Errors
/// What is no JSON, or a number that no field can be left out for.
pub fn text(value: &impl Serialize) -> Result<String, Error> {
    let odd = RefCell::new(BTreeMap::new());
    value.serialize(Walk { path: String::new(), odd: &odd })?;
    let odd = odd.into_inner();
    if odd.is_empty() {
        return serde_json::to_string_pretty(value);
    }
    let mut whole = serde_json::to_value(value)?;
    let absent: BTreeMap<String, String> =
        odd.into_iter().filter_map(|(path, found)| Some((leave_out(&mut whole, &path)?, found))).collect();
    match &mut whole {
        Value::Object(fields) => fields.insert("absent".into(), serde_json::to_value(absent)?),
        _ => return Err(Error::custom("expected finite numbers, found NaN or infinity in a list")),
    };
    serde_json::to_string_pretty(&whole)
}

/// Leave out the field that holds a number, or the list with it; its name.
fn leave_out(whole: &mut Value, path: &str) -> Option<String> {
    let (parent, name) = path.rsplit_once('/')?;
    match whole.pointer_mut(parent) {
        Some(Value::Object(fields)) => {
            fields.remove(&unescaped(name));
            Some(unescaped(&path[1..].replace('/', ".")))
        }
        _ => leave_out(whole, parent),
    }
}

fn unescaped(name: &str) -> String {
    name.replace("~1", "/").replace("~0", "~")
}

/// What looks for the numbers, by the path of a value as a JSON pointer.
#[derive(Clone)]
struct Walk<'o> {
    path: String,
    odd: &'o RefCell<BTreeMap<String, String>>,
}

/// The parts of a value, with the number or the key of the next one.
struct Parts<'o> {
    whole: Walk<'o>,
    next: usize,
    key: String,
}

impl<'o> Walk<'o> {
    fn part(&self, name: impl Display) -> Self {
        let name = name.to_string().replace('~', "~0").replace('/', "~1");
        Self { path: format!("{}/{name}", self.path), odd: self.odd }
    }

    fn parts(self) -> Result<Parts<'o>, Error> {
        Ok(Parts { whole: self, next: 0, key: String::new() })
    }

    fn number(self, number: f64) -> Result<(), Error> {
        if !number.is_finite() {
            self.odd.borrow_mut().insert(self.path, number.to_string());
        }
        Ok(())
    }
}

impl Parts<'_> {
    fn element<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Error> {
        self.next += 1;
        value.serialize(self.whole.part(self.next - 1))
    }
}

macro_rules! fine {
    ($($name:ident: $type:ty),*) => { $(fn $name(self, _: $type) -> Result<(), Error> { Ok(()) })* };
}

impl<'o> ser::Serializer for Walk<'o> {
    type Ok = ();
    type Error = Error;
    type SerializeSeq = Parts<'o>;
    type SerializeTuple = Parts<'o>;
    type SerializeTupleStruct = Parts<'o>;
    type SerializeTupleVariant = Parts<'o>;
    type SerializeMap = Parts<'o>;
    type SerializeStruct = Parts<'o>;
    type SerializeStructVariant = Parts<'o>;

    fine!(serialize_bool: bool, serialize_i8: i8, serialize_i16: i16, serialize_i32: i32, serialize_i64: i64, serialize_u8: u8,
        serialize_u16: u16, serialize_u32: u32, serialize_u64: u64, serialize_char: char, serialize_str: &str, serialize_bytes: &[u8],
        serialize_unit_struct: &'static str);

    fn serialize_f32(self, number: f32) -> Result<(), Error> {
        self.number(number.into())
    }

    fn serialize_f64(self, number: f64) -> Result<(), Error> {
        self.number(number)
    }

    fn serialize_none(self) -> Result<(), Error> {
        Ok(())
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), Error> {
        value.serialize(self)
    }

    fn serialize_unit(self) -> Result<(), Error> {
        Ok(())
    }

    fn serialize_unit_variant(self, _: &'static str, _: u32, _: &'static str) -> Result<(), Error> {
        Ok(())
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(self, _: &'static str, value: &T) -> Result<(), Error> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        value.serialize(self.part(variant))
    }

    fn serialize_seq(self, _: Option<usize>) -> Result<Parts<'o>, Error> {
        self.parts()
    }

    fn serialize_tuple(self, _: usize) -> Result<Parts<'o>, Error> {
        self.parts()
    }

    fn serialize_tuple_struct(self, _: &'static str, _: usize) -> Result<Parts<'o>, Error> {
        self.parts()
    }

    fn serialize_tuple_variant(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        _: usize,
    ) -> Result<Parts<'o>, Error> {
        self.part(variant).parts()
    }

    fn serialize_map(self, _: Option<usize>) -> Result<Parts<'o>, Error> {
        self.parts()
    }

    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Parts<'o>, Error> {
        self.parts()
    }

    fn serialize_struct_variant(
        self,
        _: &'static str,
        _: u32,
        variant: &'static str,
        _: usize,
    ) -> Result<Parts<'o>, Error> {
        self.part(variant).parts()
    }
}

macro_rules! list {
    ($($kind:ident::$method:ident),*) => { $(impl ser::$kind for Parts<'_> {
        type Ok = ();
        type Error = Error;

        fn $method<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Error> {
            self.element(value)
        }

        fn end(self) -> Result<(), Error> {
            Ok(())
        }
    })* };
}

macro_rules! fields {
    ($($kind:ident),*) => { $(impl ser::$kind for Parts<'_> {
        type Ok = ();
        type Error = Error;

        fn serialize_field<T: Serialize + ?Sized>(&mut self, key: &'static str, value: &T) -> Result<(), Error> {
            value.serialize(self.whole.part(key))
        }

        fn end(self) -> Result<(), Error> {
            Ok(())
        }
    })* };
}

list!(
    SerializeSeq::serialize_element,
    SerializeTuple::serialize_element,
    SerializeTupleStruct::serialize_field,
    SerializeTupleVariant::serialize_field
);
fields!(SerializeStruct, SerializeStructVariant);

impl ser::SerializeMap for Parts<'_> {
    type Ok = ();
    type Error = Error;

    fn serialize_key<T: Serialize + ?Sized>(&mut self, key: &T) -> Result<(), Error> {
        self.key = match serde_json::to_value(key)? {
            Value::String(text) => text,
            other => other.to_string(),
        };
        Ok(())
    }

    fn serialize_value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result<(), Error> {
        value.serialize(self.whole.part(&self.key))
    }

    fn end(self) -> Result<(), Error> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct Inner {
        mean: f64,
        sigma: Option<f32>,
    }

    #[derive(Serialize)]
    struct Whole {
        z: f64,
        vars: Vec<Inner>,
        covariance: [[f64; 2]; 2],
        by_name: BTreeMap<&'static str, f64>,
        #[serde(flatten)]
        flat: Option<Inner>,
    }

    fn whole(mean: f64, covariance: f64, b: f64) -> Value {
        let inner = |mean| Inner { mean, sigma: Some(0.5) };
        let by_name = BTreeMap::from([("x/y", b)]);
        let covariance = [[1.0, covariance], [covariance, 1.0]];
        let whole = Whole { z: 1.0, vars: vec![inner(2.0), inner(mean)], covariance, by_name, flat: Some(inner(3.0)) };
        serde_json::from_str(&text(&whole).unwrap()).unwrap()
    }

    #[test]
    fn a_number_that_is_none_is_absent_and_named() {
        let json = whole(f64::NAN, f64::INFINITY, f64::NEG_INFINITY);
        assert_eq!(json["vars"], serde_json::json!([{"mean": 2.0, "sigma": 0.5}, {"sigma": 0.5}]));
        assert_eq!(
            (json.get("covariance"), &json["by_name"], &json["mean"]),
            (None, &serde_json::json!({}), &3.0.into())
        );
        let absent = serde_json::json!({"vars.1.mean": "NaN", "covariance": "inf", "by_name.x/y": "-inf"});
        assert_eq!(json["absent"], absent);
    }

    #[test]
    fn finite_numbers_stay_as_they_are() {
        assert_eq!(whole(4.0, 0.5, 6.0).get("absent"), None);
        assert!(text(&[f64::NAN]).unwrap_err().to_string().contains("expected finite numbers"));
    }
}
