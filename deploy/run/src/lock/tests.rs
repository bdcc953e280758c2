use std::cell::{Cell, RefCell};
use std::fs;
use std::io;
use std::thread;
use std::time::Instant;

use super::holder::Origin;
use super::*;

/// Wait for the children of a dead supervisor.
const WAIT: Duration = Duration::from_secs(70);

/// What happens while a process waits.
type Meanwhile<'a> = Box<dyn FnMut(&FakeMachine<'_>) + 'a>;

/// A machine with its own clock and processes. Its `flock` behaves as on a file system whose locks
/// are local, unless set otherwise.
struct FakeMachine<'a> {
    this: Holder,
    alive: RefCell<Vec<u32>>,
    file_lock: Cell<FileLock>,
    open_elsewhere: Cell<bool>,
    now: Cell<Duration>,
    /// Called after each wait.
    meanwhile: RefCell<Meanwhile<'a>>,
}

impl<'a> FakeMachine<'a> {
    fn new(host: &str, pid: u32) -> Self {
        Self {
            this: process(host, pid),
            alive: RefCell::new(vec![pid]),
            file_lock: Cell::new(FileLock::Taken),
            open_elsewhere: Cell::new(false),
            now: Cell::new(Duration::ZERO),
            meanwhile: RefCell::new(Box::new(|_| ())),
        }
    }

    fn meanwhile(self, action: impl FnMut(&FakeMachine<'_>) + 'a) -> Self {
        *self.meanwhile.borrow_mut() = Box::new(action);
        self
    }

    fn with_lock(self, lock: FileLock) -> Self {
        self.file_lock.set(lock);
        self
    }
}

impl Machine for FakeMachine<'_> {
    fn this(&self) -> Holder {
        self.this.clone()
    }

    fn is_alive(&self, holder: &Holder) -> Option<bool> {
        holder.is_beside(&self.this).then(|| self.alive.borrow().contains(&holder.pid))
    }

    fn try_lock(&self, _: &File) -> io::Result<FileLock> {
        Ok(self.file_lock.get())
    }

    fn is_open_elsewhere(&self, _: &Path) -> bool {
        self.open_elsewhere.get()
    }

    fn now(&self) -> Duration {
        self.now.get()
    }

    fn sleep(&self, duration: Duration) {
        self.now.set(self.now.get() + duration);
        (self.meanwhile.borrow_mut())(self);
    }
}

fn process(host: &str, pid: u32) -> Holder {
    let origin = Origin {
        host: host.to_owned(),
        boot_id: format!("boot of {host}"),
        pid_namespace: "pid:[1]".to_owned(),
        started_ticks: 7,
    };
    Holder { pid, origin: Some(origin) }
}

fn newest(run: &Path) -> FoundLease {
    lease::newest(run).unwrap().unwrap()
}

fn leases(run: &Path) -> usize {
    let names = fs::read_dir(run).unwrap().map(|entry| entry.unwrap().file_name());
    names.filter(|name| name.to_str().unwrap().starts_with("lease.")).count()
}

/// Checks a condition until it holds.
fn until(condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while !condition() {
        assert!(Instant::now() < deadline, "waited in vain");
        thread::yield_now();
    }
}

#[test]
fn a_trainer_on_another_host_is_refused_although_file_locks_are_local_or_absent() {
    for file_lock in [FileLock::Taken, FileLock::Unsupported] {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path();
        let first = FakeMachine::new("gpu1", 10).with_lock(file_lock);
        let mut held = take(run, WAIT, &first).unwrap();
        let second = FakeMachine::new("gpu2", 10).with_lock(file_lock).meanwhile(|machine| {
            if machine.now() >= lease::RENEWAL {
                assert_eq!(held.lease.renew().unwrap(), lease::Renewed::Held);
            }
        });
        let error = take(run, WAIT, &second).unwrap_err().to_string();
        assert!(error.contains("process 10 on host gpu1"), "{error}");
        assert!(second.now() <= 2 * lease::RENEWAL, "{:?}", second.now());
    }
}

#[test]
fn a_crashed_holder_on_another_host_is_replaced_once_its_lease_has_not_changed() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    let mut dead = take(run, WAIT, &FakeMachine::new("gpu1", 10)).unwrap();
    // Its last renewal comes after the other's first look, as with a renewal on its way.
    let mut renewed = false;
    dead.lease.renew().unwrap();
    let second = FakeMachine::new("gpu2", 20).meanwhile(|_| renewed = true);
    let taken = take(run, WAIT, &second).unwrap();
    assert!(second.now() >= LEASE_TIMEOUT, "{:?}", second.now());
    assert_eq!(newest(run).holder, Some(process("gpu2", 20)));
    drop(second);
    assert!(renewed, "it waited");
    // The first one was only suspended.
    assert_eq!(dead.lease.renew().unwrap(), lease::Renewed::Lost(Some(process("gpu2", 20))));
    assert_eq!(leases(run), 1);
    drop(taken);
}

/// A host that was restarted has another boot id, and another one may have the same name.
#[test]
fn a_host_name_alone_proves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    let held = take(run, WAIT, &FakeMachine::new("gpu1", 10)).unwrap();
    let mut same_name = FakeMachine::new("gpu1", 20);
    if let Some(origin) = &mut same_name.this.origin {
        origin.boot_id = "another".to_owned();
    }
    take(run, WAIT, &same_name).unwrap();
    assert!(same_name.now() >= LEASE_TIMEOUT);
    drop(held);
}

#[test]
fn a_crashed_holder_on_this_machine_is_replaced_at_once() {
    for file_lock in [FileLock::Taken, FileLock::Unsupported] {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path();
        take(run, WAIT, &FakeMachine::new("gpu1", 10)).unwrap();
        let second = FakeMachine::new("gpu1", 20).with_lock(file_lock);
        take(run, WAIT, &second).unwrap();
        assert_eq!(second.now(), Duration::ZERO);
        let alive = FakeMachine::new("gpu1", 30).with_lock(file_lock);
        alive.alive.borrow_mut().push(20);
        let error = take(run, WAIT, &alive).unwrap_err().to_string();
        assert!(error.contains("process 20 on host gpu1"), "{error}");
        assert_eq!(alive.now(), Duration::ZERO);
    }
}

#[test]
fn the_children_of_a_crashed_holder_are_waited_for() {
    let end = |machine: &FakeMachine<'_>| {
        machine.open_elsewhere.set(false);
        if machine.file_lock.get() == FileLock::Busy {
            machine.file_lock.set(FileLock::Taken);
        }
    };
    for file_lock in [FileLock::Busy, FileLock::Unsupported] {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path();
        take(run, WAIT, &FakeMachine::new("gpu1", 10)).unwrap();
        let patient = |until: Duration| {
            let machine = FakeMachine::new("gpu1", 20).with_lock(file_lock);
            machine.open_elsewhere.set(true);
            machine.meanwhile(move |machine| {
                if machine.now() >= until {
                    end(machine);
                }
            })
        };
        let too_long = patient(2 * WAIT);
        take(run, WAIT, &too_long).unwrap_err();
        assert!(too_long.now() >= WAIT);
        let ended = patient(WAIT / 2);
        take(run, WAIT, &ended).unwrap();
        assert!(ended.now() >= WAIT / 2);
    }
}

#[test]
fn a_released_run_is_free_for_every_host_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    take(run, WAIT, &FakeMachine::new("gpu1", 10)).unwrap().lease.release().unwrap();
    assert!(newest(run).released);
    let second = FakeMachine::new("gpu2", 10);
    take(run, WAIT, &second).unwrap();
    assert_eq!(second.now(), Duration::ZERO);
    assert_eq!(newest(run).number, 2);
}

#[test]
fn of_two_that_take_over_at_the_same_time_one_wins() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    take(run, WAIT, &FakeMachine::new("gpu1", 10)).unwrap();
    // Another one takes over just before this one could.
    let mut other = None;
    let second = FakeMachine::new("gpu2", 20).meanwhile(|machine| {
        if machine.now() >= LEASE_TIMEOUT && other.is_none() {
            let holder = process("gpu3", 30);
            other = Some(Lease::claim(run, 2, holder).unwrap().unwrap());
        }
    });
    let error = take(run, WAIT, &second).unwrap_err().to_string();
    assert!(error.contains("process 30 on host gpu3"), "{error}");
    // One with an old view of the folder creates a number that was there before.
    let taken = Lease::claim(run, 3, process("gpu4", 40)).unwrap().unwrap();
    assert!(Lease::claim(run, 3, process("gpu5", 50)).unwrap().is_none());
    assert!(Lease::claim(run, 2, process("gpu5", 50)).unwrap().is_none());
    assert_eq!(newest(run).holder, Some(process("gpu4", 40)));
    assert_eq!(leases(run), 1);
    drop(taken);
}

/// A holder that was killed between creating and writing its lease.
#[test]
fn an_unreadable_lease_expires_like_any_other() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    fs::write(run.join("lease.4"), "").unwrap();
    let second = FakeMachine::new("gpu2", 20);
    take(run, WAIT, &second).unwrap();
    assert!(second.now() >= LEASE_TIMEOUT);
    assert_eq!(newest(run).number, 5);
}

/// Older programs store only their process id, and have no lease.
#[test]
fn the_lock_of_an_older_program_is_understood() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    let mut child = std::process::Command::new("sleep").arg("600").spawn().unwrap();
    fs::write(run.join("lock"), format!("{}\n", child.id())).unwrap();
    // A process that has just been started has no command line yet.
    until(|| last_holder(run).unwrap().is_running());
    for file_lock in [FileLock::Busy, FileLock::Unsupported] {
        let machine = FakeMachine::new("gpu1", 20).with_lock(file_lock);
        let error = take(run, WAIT, &machine).unwrap_err().to_string();
        assert!(error.contains(&format!("process {};", child.id())), "{error}");
        assert_eq!(machine.now(), Duration::ZERO);
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let busy = FakeMachine::new("gpu1", 20).with_lock(FileLock::Busy);
    take(run, WAIT, &busy).unwrap_err();
    assert!(busy.now() >= WAIT, "its learner may be writing a checkpoint");
    take(run, WAIT, &FakeMachine::new("gpu1", 20)).unwrap();
}

#[test]
fn another_process_that_has_the_lock_file_open_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let path = fs::canonicalize(folder.path()).unwrap().join("lock");
    let file = File::create(&path).unwrap();
    let machine = ThisMachine::new();
    // A process that another test starts may have it open for a moment.
    until(|| !machine.is_open_elsewhere(&path));
    let mut child = std::process::Command::new("sleep").arg("600").stdin(file).spawn().unwrap();
    assert!(machine.is_open_elsewhere(&path));
    child.kill().unwrap();
    child.wait().unwrap();
    until(|| !machine.is_open_elsewhere(&path));
}

#[test]
fn the_lock_names_this_process_and_is_released_on_drop() {
    let folder = tempfile::tempdir().unwrap();
    let run = folder.path();
    let held = RunLock::take(run, Duration::ZERO).unwrap();
    let holder = last_holder(run).unwrap();
    assert_eq!(holder, Holder::this());
    assert!(holder.is_on_this_machine() && holder.is_running());
    assert!(holder.to_string().contains(" on host "), "{holder}");
    let first_line = fs::read_to_string(run.join("lock")).unwrap();
    assert_eq!(first_line.lines().next(), Some(&*std::process::id().to_string()));
    assert!(!newest(run).released);
    assert_eq!(held.watch().lost_to(), None);
    // As on a file system with local locks: a lock of its own for each host.
    fs::remove_file(run.join("lock")).unwrap();
    let error = RunLock::take(run, Duration::ZERO).unwrap_err().to_string();
    assert!(error.contains(&format!("process {}", std::process::id())), "{error}");
    drop(held);
    assert!(newest(run).released);
    RunLock::take(run, WAIT).unwrap();
}
