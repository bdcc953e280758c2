//! Checks an object of a cluster against the type that is generated from its published schema.

use k8s_openapi::api::core::v1::PersistentVolumeClaim;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kcr_jobset_x_k8s_io::v1alpha2::jobsets::JobSet;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Checks an object against the type of its `kind`. Unlike the types themselves it rejects fields
/// that are not in the schema.
///
/// # Errors
/// A field has another type, is missing, or is not in the schema.
pub fn check(object: &Value) -> Result<(), String> {
    match object["kind"].as_str() {
        Some("JobSet") => check_as::<JobSet>(object),
        Some("NetworkPolicy") => check_as::<NetworkPolicy>(object),
        Some("PersistentVolumeClaim") => check_as::<PersistentVolumeClaim>(object),
        other => Err(format!("{other:?}: no type for this kind")),
    }
}

fn check_as<T: Serialize + DeserializeOwned>(object: &Value) -> Result<(), String> {
    let text = |error: serde_json::Error| error.to_string();
    let typed: T = serde_json::from_value(object.clone()).map_err(text)?;
    let mut lost = Vec::new();
    compare(object, &serde_json::to_value(&typed).map_err(text)?, "", &mut lost);
    if lost.is_empty() { Ok(()) } else { Err(format!("not in the schema: {lost:?}")) }
}

/// Collects the paths of values in `written` that are absent from `back` or differ.
fn compare(written: &Value, back: &Value, path: &str, lost: &mut Vec<String>) {
    match (written, back) {
        (Value::Object(written), Value::Object(back)) => {
            for (key, value) in written {
                let back = back.get(key).unwrap_or(&Value::Null);
                compare(value, back, &format!("{path}.{key}"), lost);
            }
        }
        (Value::Array(written), Value::Array(back)) if written.len() == back.len() => {
            for (index, (written, back)) in written.iter().zip(back).enumerate() {
                compare(written, back, &format!("{path}[{index}]"), lost);
            }
        }
        _ if written == back => {}
        _ => lost.push(format!("{path}: {written}")),
    }
}
