//! Reads the commands of running processes.

/// Returns the words of `/proc/PID/cmdline` after the program `dmprl`. In an installed package,
/// that is a script of Python: `python dmprl train`.
#[must_use]
pub fn words_after_program(command_line: &[u8]) -> Vec<String> {
    let words = command_line.split(|&byte| byte == 0);
    let words: Vec<_> = words.map(|word| String::from_utf8_lossy(word).into_owned()).collect();
    let name = words[0].rsplit('/').next().unwrap_or_default();
    let program_words = if name.starts_with("python") { 2 } else { 1 };
    words.into_iter().skip(program_words).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_script_of_python_counts_as_a_program() {
        let words = |line: &str| words_after_program(line.replace(' ', "\0").as_bytes());
        assert_eq!(words("/p/target/release/dmprl train reacher"), ["train", "reacher"]);
        assert_eq!(
            words("/v/bin/python3.12 /v/bin/dmprl actor --index 1"),
            ["actor", "--index", "1"]
        );
        assert!(words("").is_empty() && words("python").is_empty());
    }
}
