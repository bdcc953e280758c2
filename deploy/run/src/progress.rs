//! Progress of long work. The crates report it through a trait; the program shows it.

/// Shows the progress of long work.
pub trait Progress {
    /// Shows the start of a stage. Without a terminal it is printed as a line.
    fn stage(&self, what: &str);

    /// Shows the current step within the stage. Only a terminal shows it.
    fn detail(&self, what: &str);

    /// Shows the amount done, out of a total. Only a terminal shows it.
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
