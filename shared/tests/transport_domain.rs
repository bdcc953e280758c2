//! Tests of the run's shared-memory directory: permissions, checks and removal.

#![allow(clippy::unwrap_used, reason = "a test's helpers fail the test")]

mod transport_support;

use std::os::unix::fs::{DirBuilderExt, PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use dmprl_shared::transport::TransportError;
use dmprl_shared::transport::shared_memory::{
    Domain, DomainError, abandoned, attach, remove_abandoned, serve, subscribe,
};
use dmprl_shared::transport::{
    ParameterPublisher, ParameterSubscriber, SegmentReceiver, SegmentSender, SendOutcome,
};
use transport_support::{LAYOUT, Parent, Process, eventually, fill, header, plan, role, snapshot};

const ENTRY: &str = "another_process_owns_a_domain";

#[test]
fn another_process_owns_a_domain() {
    let Some((token, parent, _)) = role() else { return };
    let domain = Domain::create(&parent, &token).unwrap();
    let _learner = serve(domain.path(), &plan(2, 8)).unwrap();
    std::fs::write(domain.path().join("ready"), "").unwrap();
    loop {
        std::thread::park();
    }
}

fn owner(parent: &Path, token: &str) -> (Process, PathBuf) {
    let process = Process::start(ENTRY, token, parent, 1);
    let path = parent.join(token);
    eventually("the child process owns a domain", || path.join("ready").exists().then_some(()));
    (process, path)
}

fn entries(directory: &Path) -> Vec<PathBuf> {
    // The parent is removed with its last domain.
    let Ok(entries) = directory.read_dir() else { return Vec::new() };
    let mut paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// Returns files that iceoryx2 has created in its default locations, outside of any domain.
fn resources_outside_domains() -> Vec<PathBuf> {
    let is_resource = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy();
        name.starts_with("iox2_") || name.starts_with("d_") || name.contains("global_mgmt")
    };
    let shared_memory = Path::new("/dev/shm");
    let mut paths = if shared_memory.is_dir() { entries(shared_memory) } else { Vec::new() };
    paths.retain(is_resource);
    paths
}

#[test]
fn dropping_the_domain_removes_all_files() {
    let outside_before = resources_outside_domains();
    let default_existed = Path::new("/tmp/iceoryx2").exists();
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(2, 8);
    let mut learner = serve(domain.path(), &plan).unwrap();
    let mut worker = attach(domain.path(), &plan, 1).unwrap();
    learner.parameters.publish(&snapshot(1)).unwrap();
    let block = vec![0.0; LAYOUT.block_len()];
    let sent = worker.segments.try_send(&header(1, 1, 1), &block).unwrap();
    assert_eq!(sent, SendOutcome::Delivered);
    assert_eq!(resources_outside_domains(), outside_before);
    assert_eq!(Path::new("/tmp/iceoryx2").exists(), default_existed);
    // The directory is removed before the ends, which must tolerate this.
    drop(domain);
    assert!(!parent.path().exists(), "the parent is removed with its last domain");
    drop((learner, worker));
    assert_eq!(entries(&parent.path()), Vec::<PathBuf>::new());
    assert_eq!(resources_outside_domains(), outside_before);
}

#[test]
fn only_domains_of_dead_owners_are_removed() {
    let parent = Parent::new();
    let live = parent.domain("live");
    let foreign = parent.path().join("foreign");
    std::fs::DirBuilder::new().mode(0o700).create(&foreign).unwrap();
    std::fs::write(foreign.join("owner.lock"), "").unwrap();
    let (mut process, dead) = owner(&parent.path(), "dead");
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), []);
    process.assert_alive();
    process.kill();
    let found = abandoned(&parent.path()).unwrap();
    assert_eq!(found.iter().map(|leftover| &leftover.path).collect::<Vec<_>>(), [&dead]);
    assert!(found[0].bytes > 0);
    assert!(dead.is_dir(), "`abandoned` removes nothing");
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), found);
    assert_eq!(entries(&parent.path()), [foreign, live.path().to_owned()]);
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), []);
    Domain::open(live.path()).unwrap();
}

#[test]
fn domains_half_made_or_half_removed_are_removed() {
    let parent = Parent::new();
    let live = parent.domain("live");
    for name in [".dmprl-unfinished-a", ".dmprl-condemned-b"] {
        std::fs::DirBuilder::new().mode(0o700).create(parent.path().join(name)).unwrap();
    }
    assert_eq!(remove_abandoned(&parent.path()).unwrap().len(), 2);
    assert_eq!(entries(&parent.path()), [live.path()]);
}

/// After its supervisor is killed, a learner still writes its last checkpoint.
#[test]
fn domain_is_kept_while_its_learner_is_alive() {
    let parent = Parent::new();
    let (mut process, dead) = owner(&parent.path(), "dead");
    process.kill();
    let learner = std::fs::File::open(dead.join("learner.lock")).unwrap();
    learner.try_lock().unwrap();
    assert_eq!(abandoned(&parent.path()).unwrap(), []);
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), []);
    drop(learner);
    assert_eq!(remove_abandoned(&parent.path()).unwrap().len(), 1);
    assert!(!parent.path().exists(), "the parent is removed with its last domain");
}

#[test]
fn symbolic_link_among_the_domains_is_neither_followed_nor_removed() {
    let parent = Parent::new();
    let (mut process, dead) = owner(&parent.path(), "dead");
    process.kill();
    let outside = tempfile::tempdir_in(parent.path().parent().unwrap()).unwrap();
    let theirs = outside.path().join("theirs");
    std::fs::rename(&dead, &theirs).unwrap();
    symlink(&theirs, &dead).unwrap();
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), []);
    assert!(theirs.join("domain").exists());
    // A link inside a domain is removed, but not its target.
    std::fs::remove_file(&dead).unwrap();
    std::fs::rename(&theirs, &dead).unwrap();
    std::fs::write(outside.path().join("kept"), "").unwrap();
    symlink(outside.path(), dead.join("link")).unwrap();
    assert_eq!(remove_abandoned(&parent.path()).unwrap().len(), 1);
    assert!(outside.path().join("kept").exists());
}

/// A directory between its `mkdir` and its lock must not be considered abandoned.
#[test]
fn domains_being_created_survive_the_removal_of_abandoned_ones() {
    let parent = Parent::new();
    drop(parent.domain("first"));
    let path = parent.path();
    std::thread::scope(|scope| {
        let creators: Vec<_> = ["a", "b"]
            .map(|creator| {
                let path = &path;
                scope.spawn(move || {
                    for round in 0..200 {
                        let domain = Domain::create(path, &format!("{creator}{round}")).unwrap();
                        Domain::open(domain.path()).unwrap();
                    }
                })
            })
            .into();
        while creators.iter().any(|creator| !creator.is_finished()) {
            // May also remove a directory that a creator is removing at the same time.
            for removed in remove_abandoned(&path).unwrap() {
                assert!(removed.path.to_string_lossy().contains("condemned"), "{removed:?}");
            }
        }
    });
    assert_eq!(entries(&path), Vec::<PathBuf>::new());
}

#[test]
fn missing_parent_has_no_abandoned_domains() {
    assert_eq!(remove_abandoned(&Parent::new().path()).unwrap(), []);
}

#[test]
fn existing_domain_is_not_created_again() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let error = Domain::create(&parent.path(), "run").unwrap_err();
    assert!(matches!(error, DomainError::Io { .. }), "{error}");
    Domain::open(domain.path()).unwrap();
}

#[test]
fn directory_that_is_not_private_is_rejected() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let assert_rejected = |path: &Path| {
        let error = Domain::open(path).unwrap_err();
        assert!(matches!(error, DomainError::Untrusted { .. }), "{error}");
    };
    let link = parent.path().join("link");
    symlink(domain.path(), &link).unwrap();
    assert_rejected(&link);
    std::fs::set_permissions(domain.path(), PermissionsExt::from_mode(0o755)).unwrap();
    assert_rejected(domain.path());
    std::fs::set_permissions(domain.path(), PermissionsExt::from_mode(0o700)).unwrap();
    std::fs::set_permissions(parent.path(), PermissionsExt::from_mode(0o770)).unwrap();
    let error = Domain::create(&parent.path(), "other").unwrap_err();
    assert!(matches!(error, DomainError::Untrusted { .. }), "{error}");
    assert_rejected(&parent.path());
}

#[test]
fn invalid_tokens_and_long_paths_are_rejected() {
    let parent = Parent::new();
    for token in ["", "../up", "a/b", ".hidden", &"x".repeat(33)] {
        let error = Domain::create(&parent.path(), token).unwrap_err();
        assert!(matches!(error, DomainError::Token { .. }), "{error}");
    }
    let deep = PathBuf::from(format!("/{}", "p".repeat(60)));
    let error = Domain::create(&deep, "12345678").unwrap_err();
    assert!(matches!(error, DomainError::TooLong { got: 79, .. }), "{error}");
    let message = "79 bytes including suffixes, the maximum is 70";
    assert!(error.to_string().contains(message), "{error}");
}

#[test]
fn a_second_learner_is_refused() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(1, 8);
    let learner = serve(domain.path(), &plan).unwrap();
    let error = serve(domain.path(), &plan).unwrap_err();
    assert!(matches!(error, TransportError::Domain(DomainError::Locked { .. })), "{error}");
    drop(learner);
    // A process that a concurrent test is starting has a copy of the lock until its program runs.
    eventually("the lock is free", || serve(domain.path(), &plan).ok());
}

#[test]
fn second_worker_with_the_same_index_is_rejected_while_the_first_is_alive() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(2, 8);
    let _learner = serve(domain.path(), &plan).unwrap();
    let first = attach(domain.path(), &plan, 0).unwrap();
    let error = attach(domain.path(), &plan, 0).unwrap_err();
    assert!(matches!(error, TransportError::Taken { .. }), "{error}");
    drop(first);
    attach(domain.path(), &plan, 0).unwrap();
}

#[test]
fn worker_cannot_attach_before_its_learner_and_creates_nothing() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let before = entries(domain.path());
    let error = attach(domain.path(), &plan(1, 8), 0).unwrap_err();
    assert!(matches!(error, TransportError::Middleware { .. }), "{error}");
    assert_eq!(entries(domain.path()), before);
    let learner = serve(domain.path(), &plan(1, 8)).unwrap();
    let error = attach(domain.path(), &plan(1, 8), 1).unwrap_err();
    assert!(error.to_string().contains("segments/1"), "{error}");
    drop(learner);
}

#[test]
fn a_peer_of_another_plan_is_refused_by_name() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let ours = plan(1, 8);
    let _learner = serve(domain.path(), &ours).unwrap();
    let mut theirs = vec![ours.clone(); 6];
    theirs[0].run_id = 8;
    theirs[1].architecture_hash = 9;
    theirs[2].layout.observation_len = 12;
    theirs[3].layout.segment_steps = 6;
    theirs[4].layout.action_len = 4;
    theirs[5].parameters_len = 4999;
    let names = [
        "run_id is 0x0000000000000007 there and 0x0000000000000008 here",
        "architecture_hash is",
        "observation_len is 11 there and 12 here",
        "segment_steps is 5 there and 6 here",
        "action_len is 3 there and 4 here",
        "parameters_len is 5000 there and 4999 here",
    ];
    for (plan, name) in theirs.iter().zip(names) {
        let error = attach(domain.path(), plan, 0).unwrap_err();
        assert!(matches!(error, TransportError::Incompatible { .. }), "{error}");
        assert!(error.to_string().contains(name), "{error}");
    }
    attach(domain.path(), &ours, 0).unwrap();
}

#[test]
fn workers_of_another_plan_do_not_follow_a_new_learner() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let old = plan(1, 8);
    let learner = serve(domain.path(), &old).unwrap();
    let mut worker = attach(domain.path(), &old, 0).unwrap();
    drop(learner);
    let mut new = old.clone();
    new.architecture_hash += 1;
    let _learner = serve(domain.path(), &new).unwrap();
    let error = worker.segments.renew().unwrap_err();
    assert!(matches!(error, TransportError::Incompatible { .. }), "{error}");
    let error = worker.parameters.newest(&mut snapshot(0)).unwrap_err();
    assert!(matches!(error, TransportError::Incompatible { .. }), "{error}");
}

#[test]
fn too_little_space_is_reported_with_both_numbers() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    domain.check_space(1).unwrap();
    let error = domain.check_space(u64::MAX).unwrap_err();
    assert!(
        matches!(error, DomainError::Space { needed: u64::MAX, available, .. } if available > 0),
        "{error}"
    );
    let error = serve(domain.path(), &plan(1000, 1_000_000_000)).unwrap_err();
    assert!(matches!(error, TransportError::Domain(DomainError::Space { .. })), "{error}");
}

fn used_bytes(directory: &Path) -> u64 {
    use std::os::unix::fs::MetadataExt;
    let bytes = |path: PathBuf| {
        let metadata = path.symlink_metadata().unwrap();
        if metadata.is_dir() { used_bytes(&path) } else { metadata.blocks() * 512 }
    };
    entries(directory).into_iter().map(bytes).sum()
}

#[test]
fn required_space_covers_the_measured_usage() {
    for (workers, queue_segments) in [(1, 1), (4, 64), (2, 1000)] {
        let parent = Parent::new();
        let domain = parent.domain("run");
        let plan = plan(workers, queue_segments);
        let mut learner = serve(domain.path(), &plan).unwrap();
        let worker = |index| attach(domain.path(), &plan, index).unwrap();
        let mut ends: Vec<_> = (0..workers).map(worker).collect();
        let reader = subscribe(domain.path(), &plan).unwrap();
        learner.segments.try_receive(&mut Default::default()).unwrap();
        let mut block = vec![0.0; LAYOUT.block_len()];
        for round in 1..=3 * queue_segments as u64 {
            fill(&mut block, round);
            for end in &mut ends {
                let _ = end.segments.try_send(&header(0, 1, round), &block).unwrap();
            }
            learner.parameters.publish(&snapshot(round)).unwrap();
            if round % 3 == 0 {
                learner.segments.try_receive(&mut Default::default()).unwrap();
            }
        }
        let (used, required) = (used_bytes(domain.path()), plan.required_bytes());
        println!("{workers} workers, queue {queue_segments}: {used} of {required} bytes used");
        assert!(used <= required, "{used} bytes used, {required} required");
        drop(reader);
    }
}

#[test]
fn ends_can_move_to_other_threads() {
    fn assert_send<T: Send>() {}
    assert_send::<dmprl_shared::transport::shared_memory::LearnerEnd>();
    assert_send::<dmprl_shared::transport::shared_memory::WorkerEnd>();
}
