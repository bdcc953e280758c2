//! The files of the page, embedded in the binary: the page loads nothing from the network.

/// A file of the page.
#[derive(Debug)]
pub struct PageFile {
    pub name: &'static str,
    pub content_type: &'static str,
    pub content: &'static [u8],
}

/// All files; the first is the page itself.
pub static FILES: [PageFile; 9] = [
    file("index.html", HTML, include_bytes!("page/index.html")),
    file("style.css", CSS, include_bytes!("page/style.css")),
    file("main.js", SCRIPT, include_bytes!("page/main.js")),
    file("charts.js", SCRIPT, include_bytes!("page/charts.js")),
    file("data.js", SCRIPT, include_bytes!("page/data.js")),
    file("details.js", SCRIPT, include_bytes!("page/details.js")),
    file("format.js", SCRIPT, include_bytes!("page/format.js")),
    file("uPlot.js", SCRIPT, include_bytes!("page/uplot/uPlot.iife.min.js")),
    file("uPlot.css", CSS, include_bytes!("page/uplot/uPlot.min.css")),
];

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";

const fn file(name: &'static str, content_type: &'static str, content: &'static [u8]) -> PageFile {
    PageFile { name, content_type, content }
}
