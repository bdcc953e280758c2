//! Objects of a cluster, held to the types that are made from the published schemas.
//!
//! A crate of its own, because these types have thousands of fields: the workspace's `Cargo.toml`
//! has it compiled without optimisation, which takes a tenth of the time.

use k8s_openapi::api::core::v1::PersistentVolumeClaim;
use k8s_openapi::api::networking::v1::NetworkPolicy;
use kcr_jobset_x_k8s_io::v1alpha2::jobsets::JobSet;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

/// Checks an object by its `kind`, strictly: the types themselves pass over what they have no field
/// for, as a cluster does when it is not asked to be strict.
///
/// # Errors
/// What is wrong: a type, a field that is missing, or a field that is not in the schema.
pub fn check(object: &Value) -> Result<(), String> {
    match object["kind"].as_str() {
        Some("JobSet") => check_as::<JobSet>(object),
        Some("NetworkPolicy") => check_as::<NetworkPolicy>(object),
        Some("PersistentVolumeClaim") => check_as::<PersistentVolumeClaim>(object),
        other => Err(format!("{other:?}: its type is not known here")),
    }
}

fn check_as<T: Serialize + DeserializeOwned>(object: &Value) -> Result<(), String> {
    let text = |error: serde_json::Error| error.to_string();
    let typed: T = serde_json::from_value(object.clone()).map_err(text)?;
    let mut lost = Vec::new();
    compare(object, &serde_json::to_value(&typed).map_err(text)?, "", &mut lost);
    if lost.is_empty() { Ok(()) } else { Err(format!("not in the schema: {lost:?}")) }
}

/// Paths of what is in `written` and not the same in `back`.
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
