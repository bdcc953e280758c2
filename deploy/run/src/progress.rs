//! Progress of long work. The crates report it here; the program draws it.

/// Shows the progress of long work.
pub trait Progress {
    /// Shows what begins now. Without a terminal it is printed as a line.
    fn stage(&self, what: &str);

    /// Shows what is being done within the stage. Only a terminal shows it.
    fn detail(&self, what: &str);

    /// Shows how much is done. Only a terminal shows it.
    fn at(&self, done: u64, of: u64);

    /// Shows the current state. Without a terminal a line is printed every few seconds.
    fn state(&self, what: &str);

    /// Prints a line that stays.
    fn print(&self, line: &str);
}

/// Shows nothing.
pub struct NoProgress;

impl Progress for NoProgress {
    fn stage(&self, _what: &str) {}
    fn detail(&self, _what: &str) {}
    fn at(&self, _done: u64, _of: u64) {}
    fn state(&self, _what: &str) {}
    fn print(&self, _line: &str) {}
}
