//! What a case may use of memory and time. Beyond that the process ends at once, with the seed.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use crate::{ONE_SEED, Target};

/// A case takes milliseconds; so long that only a hang takes longer, on any machine.
const CASE_LIMIT: Duration = Duration::from_secs(60);
/// Between two looks whether a case is over.
const LOOK: Duration = Duration::from_millis(500);

/// Says how to run a case alone.
pub fn tell(name: &str, seed: u64, what: &str) {
    // Not `eprintln!`: a process that ends at once takes with it what the harness keeps.
    let _ = writeln!(
        std::io::stderr(),
        "{name}, seed {seed}: {what}; alone: {ONE_SEED}={seed} cargo test --release \
         -p dmprl-tests --test fuzz {name}"
    );
}

/// What this thread's case holds, and may.
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

/// Books memory of this thread's case; the end of the process if it asks for too much.
fn book(bytes: isize) {
    // A thread that is ending has no case.
    let Ok(Some(mut account)) = ACCOUNT.try_with(Cell::get) else { return };
    if std::thread::panicking() {
        // What a backtrace takes is not the case's.
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

/// Names the case of the thread that ends the process: after too much memory, and after an
/// overflow of the stack, of which Rust tells nobody who could.
extern "C" fn on_abort(_signal: libc::c_int) {
    if let Ok(Some(account)) = ACCOUNT.try_with(|it| it.replace(None)) {
        tell(account.name, account.seed, "ended the process");
    }
}

struct Bounded;

// SAFETY: all work is the system allocator's; the account does not touch the memory.
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

/// A case under way on this thread.
pub struct Watched {
    over: Arc<AtomicBool>,
}

thread_local! {
    /// Tells the watch of this thread's cases which one is under way.
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
            // A watch that has ended has seen a panic of its own.
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
    // SAFETY: the handler only reads this thread's account and writes to standard error; the
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
