//! Builds the book and prints the path of its first page.

fn main() -> anyhow::Result<()> {
    println!("{}", dmprl_book::build()?.join("index.html").display());
    Ok(())
}
