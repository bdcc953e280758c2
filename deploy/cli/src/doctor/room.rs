//! Checks of shared memory and the kernel's limits against the needs of default runs.

use dmprl_run::format::binary_bytes;
use dmprl_supervisor::Place;
use dmprl_supervisor::capacity::{MachineLimits, Need, Space};

use super::{Check, DefaultRun};

/// Docker's default size of a container's shared memory.
const DOCKER_DEFAULT_BYTES: u64 = 64 << 20;

pub(super) fn checks(runs: &[DefaultRun]) -> Vec<Check> {
    let need = largest(runs);
    let machine = MachineLimits::this();
    let place = Place::of_this_user();
    vec![
        shared_memory(&place, machine.shared_memory.as_ref(), &need),
        limit("open files", machine.open_files, need.open_files, &need, "ulimit -n"),
        limit("memory maps", machine.maps, need.maps, &need, "sysctl -w vm.max_map_count="),
        limit("processes", machine.tasks, need.tasks, &need, "ulimit -u"),
        leftovers(&place),
    ]
}

/// Returns the largest need of any run, for each resource.
fn largest(runs: &[DefaultRun]) -> Need {
    let of = |run: &DefaultRun| Need::of(&run.config, Some(&run.task.spec()));
    let nothing = Need {
        workers: 0,
        joined: 0,
        remote: 0,
        shared_memory_bytes: 0,
        replay_bytes: 0,
        open_files: 0,
        maps: 0,
        tasks: 0,
    };
    runs.iter().map(of).fold(nothing, |most, need| Need {
        workers: most.workers.max(need.workers),
        joined: most.joined.max(need.joined),
        remote: most.remote.max(need.remote),
        shared_memory_bytes: most.shared_memory_bytes.max(need.shared_memory_bytes),
        replay_bytes: most.replay_bytes.max(need.replay_bytes),
        open_files: most.open_files.max(need.open_files),
        maps: most.maps.max(need.maps),
        tasks: most.tasks.max(need.tasks),
    })
}

fn shared_memory(place: &Place, space: Option<&Space>, need: &Need) -> Check {
    const NAME: &str = "shared memory";
    let Some(Space { path, size_bytes, free_bytes }) = space else {
        let found = format!("cannot get the size of {}", place.base().display());
        return Check::problem(NAME, found, "mount a tmpfs on /dev/shm");
    };
    let needed = format!(
        "a default run with {} here needs {}",
        need.counted(),
        binary_bytes(need.shared_memory_bytes)
    );
    let found = format!(
        "{} free of {} in {}; {needed}",
        binary_bytes(*free_bytes),
        binary_bytes(*size_bytes),
        path.display()
    );
    if *free_bytes < need.shared_memory_bytes {
        let advice = "enlarge it (Docker: --shm-size), or use fewer workers";
        return Check::problem(NAME, found, advice);
    }
    if let (taken, Some(owner)) = place.standard() {
        let advice = format!(
            "{} belongs to user {owner}; runs use a directory with another name",
            taken.display()
        );
        return Check::warning(NAME, found, advice);
    }
    if path.as_os_str() != "/dev/shm" {
        let advice = "there is no /dev/shm: segments go through files, which may be on a disk";
        return Check::warning(NAME, found, advice);
    }
    if *size_bytes <= DOCKER_DEFAULT_BYTES {
        let advice = format!(
            "not more than Docker's default of {}: enough for a default run, too little for many \
             workers or long queues (docker run --shm-size)",
            binary_bytes(DOCKER_DEFAULT_BYTES)
        );
        return Check::warning(NAME, found, advice);
    }
    Check::ok(NAME, found)
}

fn limit(name: &'static str, limit: Option<u64>, needed: u64, need: &Need, raise: &str) -> Check {
    let needs = format!("a default run with {} here needs {needed}", need.counted());
    match limit {
        None => Check::ok(name, format!("no limit; {needs}")),
        Some(limit) if limit >= needed => Check::ok(name, format!("at most {limit}; {needs}")),
        Some(limit) => {
            let space = if raise.ends_with('=') { "" } else { " " };
            let advice = format!("raise it: {raise}{space}{needed}; or use fewer workers");
            Check::problem(name, format!("at most {limit}; {needs}"), advice)
        }
    }
}

fn leftovers(place: &Place) -> Check {
    const NAME: &str = "leftovers";
    let found = match place.leftovers() {
        Ok(found) => found,
        Err(error) => {
            let advice = "no run can start: remove this directory, or set its mode to 0700";
            return Check::problem(NAME, format!("{error:#}"), advice);
        }
    };
    if found.is_empty() {
        return Check::ok(NAME, "none");
    }
    let bytes = found.iter().map(|leftover| leftover.bytes).sum();
    let found = format!("{} of {} dead runs", binary_bytes(bytes), found.len());
    Check::warning(NAME, found, "remove them with: dmprl clean; the next train does the same")
}

#[cfg(test)]
mod tests {
    use super::super::Status;
    use super::*;

    const NEED: Need = Need {
        workers: 3,
        joined: 0,
        remote: 0,
        shared_memory_bytes: 5 << 20,
        replay_bytes: 0,
        open_files: 100,
        maps: 1,
        tasks: 1,
    };

    fn room(size_bytes: u64, free_bytes: u64) -> Check {
        let space = Space { path: "/dev/shm".into(), size_bytes, free_bytes };
        shared_memory(&Place::of_this_user(), Some(&space), &NEED)
    }

    #[test]
    fn dockers_default_shared_memory_is_a_warning_that_states_the_need() {
        let check = room(64 << 20, 64 << 20);
        assert_eq!(check.status, Status::Warning);
        assert!(check.found.contains("with 3 workers here needs 5 MiB"), "{check:?}");
        assert!(check.advice.unwrap().contains("--shm-size"));
        assert_eq!(room(1 << 30, 5 << 20).status, Status::Ok);
        assert_eq!(room(1 << 30, (5 << 20) - 1).status, Status::Problem);
        assert_eq!(shared_memory(&Place::of_this_user(), None, &NEED).status, Status::Problem);
    }

    #[test]
    fn a_limit_below_the_need_is_a_problem_with_the_command_that_raises_it() {
        let files = |max| limit("open files", max, NEED.open_files, &NEED, "ulimit -n");
        assert_eq!(files(None).status, Status::Ok);
        assert_eq!(files(Some(100)).status, Status::Ok);
        let short = files(Some(99));
        assert_eq!(short.status, Status::Problem);
        assert!(short.advice.unwrap().contains("ulimit -n 100"));
    }
}
