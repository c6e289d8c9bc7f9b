//! The JSON schema of a result, from the type that is written.
//!
//! A number that is not finite is left out of the JSON and named in `absent`, so no field that holds numbers is required; all others
//! that are always written are. A field that may be left out is never null. Objects are not closed: a field may be added.

use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema};
use serde_json::{Map, Value, json};

/// Schema of the JSON of a result, draft 2020-12.
///
/// ```
/// let fit = results::schema::<results::FitResult>();
/// assert_eq!(fit.get("properties").unwrap()["frames"]["type"], "integer");
/// ```
pub fn schema<T: JsonSchema>() -> Schema {
    let generator = SchemaSettings::draft2020_12().for_serialize().into_generator();
    let mut schema = Value::from(generator.into_root_schema_for::<T>());
    let definitions = schema.get("$defs").and_then(Value::as_object).cloned().unwrap_or_default();
    state_absence(&mut schema, &definitions);
    schema["properties"]["absent"] = json!({
        "description": "Fields that are left out because their number is not finite, by path, and what it was.",
        "type": "object",
        "additionalProperties": {"enum": ["NaN", "inf", "-inf"]},
    });
    Schema::try_from(schema).expect("a schema with one property more is a schema")
}

/// Take fields that hold numbers from what objects require, and null from fields that may be left out.
fn state_absence(schema: &mut Value, definitions: &Map<String, Value>) {
    if let Value::Object(object) = schema {
        let mut required = object.remove("required").and_then(|names| names.as_array().cloned()).unwrap_or_default();
        for (name, property) in object.get_mut("properties").and_then(Value::as_object_mut).into_iter().flatten() {
            if !required.iter().any(|one| one == name) {
                take_null(property);
            } else if holds_numbers(property, definitions) {
                required.retain(|one| one != name);
            }
        }
        if !required.is_empty() {
            object.insert("required".into(), required.into());
        }
    }
    parts(schema).for_each(|part| state_absence(part, definitions));
}

fn take_null(schema: &mut Value) {
    for key in ["type", "anyOf"] {
        if let Some(Value::Array(choices)) = schema.get_mut(key) {
            choices.retain(|choice| choice != "null" && *choice != json!({"type": "null"}));
        }
    }
}

fn parts(value: &mut Value) -> Box<dyn Iterator<Item = &mut Value> + '_> {
    match value {
        Value::Object(object) => Box::new(object.values_mut()),
        Value::Array(list) => Box::new(list.iter_mut()),
        _ => Box::new(core::iter::empty()),
    }
}

/// True for a number that need not be whole, and for lists of them at any depth; an object has fields of its own.
fn holds_numbers(schema: &Value, definitions: &Map<String, Value>) -> bool {
    let holds = |part: &Value| holds_numbers(part, definitions);
    match schema {
        Value::String(word) => word == "number",
        Value::Array(parts) => parts.iter().any(holds),
        Value::Object(object) => {
            let named = object.get("$ref").and_then(Value::as_str).and_then(|path| path.rsplit('/').next());
            let inner = ["type", "items", "prefixItems", "anyOf"].into_iter().filter_map(|key| object.get(key));
            inner.chain(named.and_then(|name| definitions.get(name))).any(holds)
        }
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Serialize;

    #[derive(Serialize, JsonSchema)]
    #[allow(dead_code)] // only its schema is asked for
    struct Pair([f64; 2]);

    #[derive(Serialize, JsonSchema)]
    #[allow(dead_code)] // only its schema is asked for
    struct Whole {
        name: String,
        count: u32,
        number: f64,
        matrix: Vec<Vec<f32>>,
        pair: Pair,
        by_gain: Vec<([f64; 2], u32)>,
        inner: Vec<Inner>,
        #[serde(skip_serializing_if = "Option::is_none")]
        perhaps: Option<String>,
        nullable: Option<String>,
    }

    #[derive(Serialize, JsonSchema)]
    #[allow(dead_code)] // only its schema is asked for
    struct Inner {
        state: &'static str,
        sigma: f64,
    }

    #[test]
    fn what_is_always_written_is_required_and_a_number_is_not() {
        let schema = Value::from(schema::<Whole>());
        assert_eq!(schema["required"], json!(["name", "count", "inner", "nullable"]));
        assert_eq!(schema["properties"]["perhaps"]["type"], json!(["string"]));
        assert_eq!(schema["properties"]["nullable"]["type"], json!(["string", "null"]));
        assert_eq!(schema["$defs"]["Inner"]["required"], json!(["state"]));
        assert_eq!(schema["properties"]["absent"]["type"], "object");
    }
}
