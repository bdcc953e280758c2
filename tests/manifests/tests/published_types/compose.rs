//! Checks the services of `deploy/compose.yaml`.

use serde_yaml_ng::Value;

use super::read;

#[test]
fn compose_file_gives_shared_memory_and_no_rights() {
    let mut file: Value = serde_yaml_ng::from_str(&read("deploy/compose.yaml")).unwrap();
    file.apply_merge().unwrap();
    let services = serde_json::to_value(&file["services"]).unwrap();
    for (name, service) in services.as_object().unwrap() {
        assert_eq!(service["read_only"], true, "{name}");
        assert_eq!(service["cap_drop"][0], "ALL", "{name}");
        assert!(service["restart"].as_str().unwrap().starts_with("on-failure:"), "{name}");
        assert!(service.get("ports").is_none(), "{name} publishes a port");
    }
    for name in ["learner", "workers"] {
        assert!(services[name]["shm_size"].is_string(), "{name}");
    }
}
