//! Checks `deploy/kubernetes/jobset.yaml` against the published types.

use serde::Deserialize;
use serde_json::{Value, json};

use super::read;
use super::schema::check;

const MANIFEST: &str = "deploy/kubernetes/jobset.yaml";
/// User id of `deploy/Dockerfile`.
const USER: i64 = 10_001;

/// Returns the documents of the manifest, by kind.
fn documents() -> Vec<(String, Value)> {
    let text = read(MANIFEST);
    let documents = serde_yaml_ng::Deserializer::from_str(&text);
    let parsed = documents.map(|document| {
        let mut value = serde_yaml_ng::Value::deserialize(document).unwrap();
        value.apply_merge().unwrap();
        let value = serde_json::to_value(value).unwrap();
        (value["kind"].as_str().unwrap().to_owned(), value)
    });
    parsed.collect()
}

fn document(kind: &str) -> Value {
    let mut of_kind = documents().into_iter().filter(|(it, _)| it == kind);
    let (_, value) = of_kind.next().unwrap_or_else(|| panic!("no {kind} in {MANIFEST}"));
    assert!(of_kind.next().is_none(), "one {kind} is enough");
    value
}

/// Returns name and template of each kind of Job in the set.
fn jobs() -> Vec<(String, Value)> {
    let set = document("JobSet");
    let jobs = set["spec"]["replicatedJobs"].as_array().unwrap().iter();
    let job = |job: &Value| (job["name"].as_str().unwrap().to_owned(), job["template"].clone());
    jobs.map(job).collect()
}

fn pods() -> Vec<(String, Value)> {
    let pod = |(name, job): (String, Value)| (name, job["spec"]["template"]["spec"].clone());
    jobs().into_iter().map(pod).collect()
}

/// Returns all containers of a pod, init containers first.
fn containers(pod: &Value) -> Vec<&Value> {
    let kinds = ["initContainers", "containers"];
    kinds.iter().flat_map(|kind| pod[*kind].as_array().unwrap()).collect()
}

fn mounts(container: &Value) -> &[Value] {
    container["volumeMounts"].as_array().unwrap()
}

#[test]
fn every_document_is_what_the_published_types_say() {
    let mut kinds = Vec::new();
    for (kind, value) in documents() {
        check(&value).unwrap_or_else(|error| panic!("{kind}: {error}"));
        kinds.push(kind);
    }
    assert_eq!(kinds, ["PersistentVolumeClaim", "NetworkPolicy", "JobSet"]);
}

#[test]
fn what_no_schema_has_is_found() {
    let pod = "/spec/replicatedJobs/0/template/spec/template/spec";
    let container = &format!("{pod}/containers/0/securityContext");
    for (pointer, key, value) in [
        ("/spec", "restartPolicies", json!({})),
        ("/spec/successPolicy", "operator", json!("Most")),
        ("/spec/replicatedJobs/1", "replicas", json!("two")),
        (pod, "readOnlyRootFilesystem", json!(true)),
        (container, "runAsUser", json!("somebody")),
    ] {
        let mut set = document("JobSet");
        set.pointer_mut(pointer).unwrap()[key] = value;
        assert!(check(&set).is_err(), "{pointer}/{key}");
    }
}

#[test]
fn workers_look_for_the_learner_by_the_name_that_its_pod_has() {
    let set = document("JobSet");
    let network = &set["spec"]["network"];
    assert_eq!(network["enableDNSHostnames"], true);
    let [set_name, subdomain] =
        [&set["metadata"]["name"], &network["subdomain"]].map(|it| it.as_str().unwrap());
    let connect = format!("--connect=tls/{set_name}-learner-0-0.{subdomain}:7447");
    for (name, pod) in pods() {
        let arguments = &pod["containers"][0]["args"];
        let wanted = match name.as_str() {
            "learner" => "--set=bridge.listen=[\"tls/0.0.0.0:7447\"]",
            _ => connect.as_str(),
        };
        assert!(arguments.as_array().unwrap().iter().any(|it| it == wanted), "{arguments}");
    }
}

#[test]
fn each_pod_has_shared_memory_of_its_own_within_its_limit() {
    for (name, pod) in pods() {
        let container = &pod["containers"][0];
        let shm = mounts(container).iter().find(|it| it["mountPath"] == "/dev/shm").unwrap();
        let volumes = pod["volumes"].as_array().unwrap();
        let volume = |mount: &Value| volumes.iter().find(|it| it["name"] == mount["name"]);
        let directory = &volume(shm).unwrap()["emptyDir"];
        assert_eq!(directory["medium"], "Memory", "{name}");
        let limit = &container["resources"]["limits"]["memory"];
        assert!(2 * mebibytes(&directory["sizeLimit"]) <= mebibytes(limit), "{name}: of {limit}");
        // Only the cluster detects a mount without a volume, after everything has been sent.
        for mount in containers(&pod).into_iter().flat_map(mounts) {
            assert!(volume(mount).is_some(), "{name}: {mount}");
        }
    }
}

/// Parses a quantity of memory in Mi or Gi.
fn mebibytes(quantity: &Value) -> u64 {
    let quantity = quantity.as_str().unwrap();
    let (number, unit) = quantity.split_at(quantity.len() - 2);
    let number: u64 = number.parse().unwrap();
    match unit {
        "Mi" => number,
        "Gi" => number * 1024,
        other => panic!("{other}: no unit that is used here"),
    }
}

#[test]
fn nothing_runs_as_root_or_writes_to_its_image() {
    assert!(read("deploy/Dockerfile").contains(&format!("\nUSER {USER}:{USER}\n")));
    for (name, pod) in pods() {
        let security = &pod["securityContext"];
        assert_eq!(
            (&security["runAsNonRoot"], &security["runAsUser"]),
            (&json!(true), &json!(USER))
        );
        assert_eq!(pod["enableServiceLinks"], false, "{name}: a service would set DMPRL_…");
        assert_eq!(pod["automountServiceAccountToken"], false, "{name}");
        for container in containers(&pod) {
            let security = &container["securityContext"];
            assert_eq!(security["readOnlyRootFilesystem"], true, "{container}");
            assert_eq!(security["allowPrivilegeEscalation"], false, "{container}");
            for kind in ["requests", "limits"] {
                assert!(container["resources"][kind]["memory"].is_string(), "{container}");
            }
        }
    }
}

#[test]
fn wrong_use_ends_a_job_and_a_lost_node_costs_none_of_its_tries() {
    for (name, job) in jobs() {
        let pod = &job["spec"]["template"]["spec"];
        // Requirements of a pod failure policy.
        assert_eq!(pod["restartPolicy"], "Never", "{name}");
        assert!(pod["terminationGracePeriodSeconds"].as_u64().unwrap() > 10, "{name}");
        let rules = &job["spec"]["podFailurePolicy"]["rules"];
        assert_eq!(rules[0]["action"], "Ignore", "{name}");
        assert_eq!(rules[0]["onPodConditions"][0]["type"], "DisruptionTarget", "{name}");
        let codes = &rules[1]["onExitCodes"];
        assert_eq!((&rules[1]["action"], &codes["values"]), (&json!("FailJob"), &json!([2])));
        assert_eq!(codes["containerName"], pod["containers"][0]["name"], "{name}");
    }
}
