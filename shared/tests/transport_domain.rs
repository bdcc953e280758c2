//! The run's shared-memory directory: its permissions, its checks and its removal.

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
    eventually("the other process owns a domain", || path.join("ready").exists().then_some(()));
    (process, path)
}

fn entries(directory: &Path) -> Vec<PathBuf> {
    // The last domain removes its parent.
    let Ok(entries) = directory.read_dir() else { return Vec::new() };
    let mut paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    paths
}

/// Files that iceoryx2 creates in its default locations if a resource is not in the domain.
fn loose_resources() -> Vec<PathBuf> {
    let loose = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy();
        name.starts_with("iox2_") || name.starts_with("d_") || name.contains("global_mgmt")
    };
    let shared_memory = Path::new("/dev/shm");
    let mut paths = if shared_memory.is_dir() { entries(shared_memory) } else { Vec::new() };
    paths.retain(loose);
    paths
}

#[test]
fn nothing_is_left_when_the_domain_is_dropped() {
    let loose_before = loose_resources();
    let default_place = Path::new("/tmp/iceoryx2").exists();
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(2, 8);
    let mut learner = serve(domain.path(), &plan).unwrap();
    let mut worker = attach(domain.path(), &plan, 1).unwrap();
    learner.parameters.publish(&snapshot(1)).unwrap();
    let block = vec![0.0; LAYOUT.block_len()];
    let sent = worker.segments.try_send(&header(1, 1, 1), &block).unwrap();
    assert_eq!(sent, SendOutcome::Delivered);
    assert_eq!(loose_resources(), loose_before);
    assert_eq!(Path::new("/tmp/iceoryx2").exists(), default_place);
    // The directory is removed first; ends that outlive it must tolerate this.
    drop(domain);
    assert!(!parent.path().exists(), "the last domain takes its parent along");
    drop((learner, worker));
    assert_eq!(entries(&parent.path()), Vec::<PathBuf>::new());
    assert_eq!(loose_resources(), loose_before);
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
    assert!(dead.is_dir(), "looking removes nothing");
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

/// A learner whose supervisor was killed still writes its last checkpoint.
#[test]
fn a_domain_stays_as_long_as_its_learner_lives() {
    let parent = Parent::new();
    let (mut process, dead) = owner(&parent.path(), "dead");
    process.kill();
    let learner = std::fs::File::open(dead.join("learner.lock")).unwrap();
    learner.try_lock().unwrap();
    assert_eq!(abandoned(&parent.path()).unwrap(), []);
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), []);
    drop(learner);
    assert_eq!(remove_abandoned(&parent.path()).unwrap().len(), 1);
    assert!(!parent.path().exists(), "the last domain takes its parent along");
}

#[test]
fn a_link_among_the_domains_is_neither_followed_nor_removed() {
    let parent = Parent::new();
    let (mut process, dead) = owner(&parent.path(), "dead");
    process.kill();
    let outside = tempfile::tempdir_in(parent.path().parent().unwrap()).unwrap();
    let theirs = outside.path().join("theirs");
    std::fs::rename(&dead, &theirs).unwrap();
    symlink(&theirs, &dead).unwrap();
    assert_eq!(remove_abandoned(&parent.path()).unwrap(), []);
    assert!(theirs.join("domain").exists());
    // A link inside a domain is removed without its target.
    std::fs::remove_file(&dead).unwrap();
    std::fs::rename(&theirs, &dead).unwrap();
    std::fs::write(outside.path().join("kept"), "").unwrap();
    symlink(outside.path(), dead.join("link")).unwrap();
    assert_eq!(remove_abandoned(&parent.path()).unwrap().len(), 1);
    assert!(outside.path().join("kept").exists());
}

/// A directory between `mkdir` and its lock must not count as abandoned.
#[test]
fn domains_being_made_survive_the_removal_of_abandoned_ones() {
    let parent = Parent::new();
    drop(parent.domain("first"));
    let path = parent.path();
    std::thread::scope(|scope| {
        let makers: Vec<_> = ["a", "b"]
            .map(|maker| {
                let path = &path;
                scope.spawn(move || {
                    for round in 0..200 {
                        let domain = Domain::create(path, &format!("{maker}{round}")).unwrap();
                        Domain::open(domain.path()).unwrap();
                    }
                })
            })
            .into();
        while makers.iter().any(|maker| !maker.is_finished()) {
            // A directory that a maker is removing may be removed here too.
            for removed in remove_abandoned(&path).unwrap() {
                assert!(removed.path.to_string_lossy().contains("condemned"), "{removed:?}");
            }
        }
    });
    assert_eq!(entries(&path), Vec::<PathBuf>::new());
}

#[test]
fn a_missing_parent_has_nothing_abandoned() {
    assert_eq!(remove_abandoned(&Parent::new().path()).unwrap(), []);
}

#[test]
fn a_domain_that_exists_is_not_made_again() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let refusal = Domain::create(&parent.path(), "run").unwrap_err();
    assert!(matches!(refusal, DomainError::Io { .. }), "{refusal}");
    Domain::open(domain.path()).unwrap();
}

#[test]
fn what_is_not_private_is_refused() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let refused = |path: &Path| {
        let refusal = Domain::open(path).unwrap_err();
        assert!(matches!(refusal, DomainError::Untrusted { .. }), "{refusal}");
    };
    let link = parent.path().join("link");
    symlink(domain.path(), &link).unwrap();
    refused(&link);
    std::fs::set_permissions(domain.path(), PermissionsExt::from_mode(0o755)).unwrap();
    refused(domain.path());
    std::fs::set_permissions(domain.path(), PermissionsExt::from_mode(0o700)).unwrap();
    std::fs::set_permissions(parent.path(), PermissionsExt::from_mode(0o770)).unwrap();
    let refusal = Domain::create(&parent.path(), "other").unwrap_err();
    assert!(matches!(refusal, DomainError::Untrusted { .. }), "{refusal}");
    refused(&parent.path());
}

#[test]
fn names_that_do_not_fit_are_refused_with_their_length() {
    let parent = Parent::new();
    for token in ["", "../up", "a/b", ".hidden", &"x".repeat(33)] {
        let refusal = Domain::create(&parent.path(), token).unwrap_err();
        assert!(matches!(refusal, DomainError::Token { .. }), "{refusal}");
    }
    let deep = PathBuf::from(format!("/{}", "p".repeat(60)));
    let refusal = Domain::create(&deep, "12345678").unwrap_err();
    assert!(matches!(refusal, DomainError::TooLong { got: 79, .. }), "{refusal}");
    assert!(refusal.to_string().contains("79 bytes with what is added, at most 70"), "{refusal}");
}

#[test]
fn a_second_learner_is_refused() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(1, 8);
    let learner = serve(domain.path(), &plan).unwrap();
    let refusal = serve(domain.path(), &plan).unwrap_err();
    assert!(matches!(refusal, TransportError::Domain(DomainError::Locked { .. })), "{refusal}");
    drop(learner);
    serve(domain.path(), &plan).unwrap();
}

#[test]
fn a_second_worker_of_the_same_index_is_refused_as_long_as_the_first_lives() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let plan = plan(2, 8);
    let _learner = serve(domain.path(), &plan).unwrap();
    let first = attach(domain.path(), &plan, 0).unwrap();
    let refusal = attach(domain.path(), &plan, 0).unwrap_err();
    assert!(matches!(refusal, TransportError::Taken { .. }), "{refusal}");
    drop(first);
    attach(domain.path(), &plan, 0).unwrap();
}

#[test]
fn a_worker_before_its_learner_is_refused_and_creates_nothing() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    let before = entries(domain.path());
    let refusal = attach(domain.path(), &plan(1, 8), 0).unwrap_err();
    assert!(matches!(refusal, TransportError::Middleware { .. }), "{refusal}");
    assert_eq!(entries(domain.path()), before);
    let learner = serve(domain.path(), &plan(1, 8)).unwrap();
    let refusal = attach(domain.path(), &plan(1, 8), 1).unwrap_err();
    assert!(refusal.to_string().contains("segments/1"), "{refusal}");
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
        let refusal = attach(domain.path(), plan, 0).unwrap_err();
        assert!(matches!(refusal, TransportError::Incompatible { .. }), "{refusal}");
        assert!(refusal.to_string().contains(name), "{refusal}");
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
    let refusal = worker.segments.renew().unwrap_err();
    assert!(matches!(refusal, TransportError::Incompatible { .. }), "{refusal}");
    let refusal = worker.parameters.newest(&mut snapshot(0)).unwrap_err();
    assert!(matches!(refusal, TransportError::Incompatible { .. }), "{refusal}");
}

#[test]
fn too_little_space_is_reported_with_both_numbers() {
    let parent = Parent::new();
    let domain = parent.domain("run");
    domain.check_space(1).unwrap();
    let refusal = domain.check_space(u64::MAX).unwrap_err();
    assert!(
        matches!(refusal, DomainError::Space { needed: u64::MAX, available, .. } if available > 0),
        "{refusal}"
    );
    let refusal = serve(domain.path(), &plan(1000, 1_000_000_000)).unwrap_err();
    assert!(matches!(refusal, TransportError::Domain(DomainError::Space { .. })), "{refusal}");
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
fn the_space_asked_for_covers_what_is_used() {
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
        let (used, asked) = (used_bytes(domain.path()), plan.required_bytes());
        println!("{workers} workers, queue {queue_segments}: {used} bytes used, {asked} asked for");
        assert!(used <= asked, "{used} bytes used, {asked} asked for");
        drop(reader);
    }
}

#[test]
fn the_ends_may_move_to_other_threads() {
    fn movable<T: Send>() {}
    movable::<dmprl_shared::transport::shared_memory::LearnerEnd>();
    movable::<dmprl_shared::transport::shared_memory::WorkerEnd>();
}
