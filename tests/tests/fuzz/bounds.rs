//! Limits of memory and time for a case. Beyond them the process ends at once and prints the seed.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::{ONE_SEED, Target};

/// A case takes milliseconds; only a hang takes this long, on any machine.
const CASE_LIMIT: Duration = Duration::from_secs(60);
/// Interval between two checks whether a case has ended.
const LOOK: Duration = Duration::from_millis(500);

/// Prints how to run a case alone.
pub fn tell(name: &str, seed: u64, what: &str) {
    // Not `eprintln!`: its output, which the harness captures, is lost when the process ends at
    // once.
    let _ = writeln!(
        std::io::stderr(),
        "{name}, seed {seed}: {what}; alone: {ONE_SEED}={seed} cargo test --release \
         -p dmprl-tests --test fuzz {name}"
    );
}

/// Memory in use and its limit for this thread's case.
#[derive(Clone, Copy)]
struct Account {
    name: &'static str,
    seed: u64,
    held: isize,
    most: usize,
}

thread_local! {
    static ACCOUNT: Cell<Option<Account>> = const { Cell::new(None) };
}

/// Counts memory of this thread's case; ends the process if it exceeds the limit.
fn book(bytes: isize) {
    // A thread that is ending has no case.
    let Ok(Some(mut account)) = ACCOUNT.try_with(Cell::get) else { return };
    if std::thread::panicking() {
        // Memory for a backtrace is not counted.
        return;
    }
    account.held += bytes;
    if account.held > 0 && account.held.unsigned_abs() > account.most {
        let _ = ACCOUNT.try_with(|it| it.set(None));
        tell(account.name, account.seed, &format!("holds more than {} bytes", account.most));
        std::process::abort();
    }
    let _ = ACCOUNT.try_with(|it| it.set(Some(account)));
}

/// Names the case of the thread that ends the process, after too much memory or a stack overflow,
/// which Rust does not report to the harness.
extern "C" fn on_abort(_signal: libc::c_int) {
    if let Ok(Some(account)) = ACCOUNT.try_with(|it| it.replace(None)) {
        tell(account.name, account.seed, "ended the process");
    }
}

struct Bounded;

// SAFETY: the system allocator does all work; the counter does not touch the memory.
unsafe impl GlobalAlloc for Bounded {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        book(layout.size().cast_signed());
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        book(layout.size().cast_signed());
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        book(-layout.size().cast_signed());
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        book(size.cast_signed() - layout.size().cast_signed());
        // SAFETY: the caller's promise is passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Bounded = Bounded;

/// A running case of this thread.
pub struct Watched {
    over: Arc<AtomicBool>,
}

thread_local! {
    /// Reports the running case to this thread's watchdog.
    static WATCH: std::cell::RefCell<Option<std::sync::mpsc::Sender<Begun>>> =
        const { std::cell::RefCell::new(None) };
}

struct Begun {
    name: &'static str,
    seed: u64,
    over: Arc<AtomicBool>,
}

impl Watched {
    pub fn new(target: Target, seed: u64) -> Self {
        let Target { name, bytes_max, .. } = target;
        let over = Arc::new(AtomicBool::new(false));
        let begun = Begun { name, seed, over: Arc::clone(&over) };
        WATCH.with_borrow_mut(|watch| {
            // The watchdog has ended only if it panicked itself.
            let _ = watch.get_or_insert_with(start_watch).send(begun);
        });
        ACCOUNT.set(Some(Account { name, seed, held: 0, most: bytes_max }));
        Self { over }
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        ACCOUNT.set(None);
        self.over.store(true, Ordering::Release);
    }
}

fn start_watch() -> std::sync::mpsc::Sender<Begun> {
    let handler = on_abort as extern "C" fn(libc::c_int);
    // SAFETY: the handler only reads this thread's counter and writes to standard error; the
    // process ends after it in any case.
    unsafe { libc::signal(libc::SIGABRT, handler as libc::sighandler_t) };
    let (sender, cases) = std::sync::mpsc::channel::<Begun>();
    std::thread::spawn(move || {
        for Begun { name, seed, over } in cases {
            let begun = Instant::now();
            while !over.load(Ordering::Acquire) {
                if begun.elapsed() > CASE_LIMIT {
                    tell(name, seed, &format!("is not over after {CASE_LIMIT:?}"));
                    std::process::abort();
                }
                std::thread::sleep(LOOK);
            }
        }
    });
    sender
}
