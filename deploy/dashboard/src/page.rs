//! The files of the page, embedded in the program: it needs no network and no installation.

/// Name, type and content of every file; the first is the page itself.
pub const FILES: [(&str, &str, &[u8]); 9] = [
    ("index.html", "text/html; charset=utf-8", include_bytes!("page/index.html")),
    ("style.css", CSS, include_bytes!("page/style.css")),
    ("main.js", SCRIPT, include_bytes!("page/main.js")),
    ("charts.js", SCRIPT, include_bytes!("page/charts.js")),
    ("data.js", SCRIPT, include_bytes!("page/data.js")),
    ("details.js", SCRIPT, include_bytes!("page/details.js")),
    ("format.js", SCRIPT, include_bytes!("page/format.js")),
    ("uPlot.js", SCRIPT, include_bytes!("page/uplot/uPlot.iife.min.js")),
    ("uPlot.css", CSS, include_bytes!("page/uplot/uPlot.min.css")),
];

const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
