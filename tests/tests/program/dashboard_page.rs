//! The dashboard's page in a real browser: start, watch a curve grow, switch the axis, compare two
//! runs, and the same on a phone.
//!
//! Skipped without Chromium.

use dmprl_tests::program::Workplace;
use dmprl_tests::skipped::skipped;
use rustix::process::Signal;

use crate::browser::{self, Browser};
use crate::dashboard::start;
use crate::{ENDLESS, train};

/// Size of the first load [bytes]: page, styles, scripts, data.
const BYTES_MAX: u64 = 300_000;
/// Width of a narrow phone [CSS pixels].
const PHONE: u32 = 360;

/// True when two runs have a return.
const TWO_LINES: &str =
    "document.querySelectorAll('figure[data-key=return_mean] .readout li').length === 2";

/// True when some pixel of a chart has a colour, given as in its data.
fn draws(key: &str, colour: [u8; 3]) -> String {
    let [red, green, blue] = colour;
    format!(
        "(() => {{ const canvas = document.querySelector('figure[data-key={key}] canvas'); \
         if (!canvas?.width) return false; \
         const {{data}} = canvas.getContext('2d') \
           .getImageData(0, 0, canvas.width, canvas.height); \
         for (let at = 0; at < data.length; at += 4) \
           if (data[at] === {red} && data[at + 1] === {green} && data[at + 2] === {blue} \
               && data[at + 3] === 255) return true; \
         return false; }})()"
    )
}

/// A number that a chart reports about its drawing.
fn of_chart(browser: &Browser, key: &str, what: &str) -> f64 {
    let found = browser.evaluate(&format!(
        "Number(document.querySelector('figure[data-key={key}]').dataset.{what})"
    ));
    found.as_f64().unwrap_or_else(|| panic!("{key}: {what}"))
}

#[test]
fn a_browser_watches_a_run_grow_beside_another() {
    let Some(program) = browser::find() else {
        let remedy = "apt install chromium, or name another in TEST_CHROMIUM";
        return skipped("TEST_BROWSER_REQUIRED", "the dashboard's page in a browser", remedy);
    };
    let place = Workplace::new();
    std::fs::create_dir(place.path("runs")).unwrap();
    let [first, second] = ["runs/first", "runs/second"].map(|name| place.path(name));
    let more = ["--steps", "1000", "--algo", "ddpg", "--seed", "7"];
    place.run(&train("reacher", &first, &more)).with_status(0);
    let mut training = place.start(&train("reacher", &second, &["--steps", ENDLESS]));
    // When the page is opened, it shows the runs in training; so the run must have begun.
    training.until_steps(&second, 1_000);
    let (dashboard, address) = start(&place, &place.path("runs"));
    let browser = Browser::start(program);
    browser.resize(1280, false);
    browser.open(&address.url());

    // A run in training is shown without a click, and grows.
    let key = "env_steps_per_s";
    browser.until(&format!(
        "Number(document.querySelector('figure[data-key={key}]')?.dataset.points) > 0"
    ));
    let bytes = browser.evaluate(
        "performance.getEntries().reduce((sum, entry) => sum + (entry.transferSize ?? 0), 0)",
    );
    assert!(bytes.as_u64().unwrap() < BYTES_MAX, "{bytes} bytes");
    browser.evaluate(&format!("document.querySelector('figure[data-key={key}]').scrollIntoView()"));
    browser.until(&draws(key, [0x00, 0x9e, 0x73]));
    let points = of_chart(&browser, key, "points");
    browser.until(&format!(
        "Number(document.querySelector('figure[data-key={key}]').dataset.points) > {points}"
    ));

    // The axis ends at thousands of steps, or at seconds.
    let steps = of_chart(&browser, key, "end");
    assert!(steps >= 500.0, "{steps}");
    browser.click("input[value=wall_s]");
    browser.until("location.hash.includes('axis=wall_s')");
    browser.until(&format!(
        "Number(document.querySelector('figure[data-key={key}]').dataset.end) < {steps}"
    ));

    compare_with(&browser, "first");
    look_on_a_phone(&browser);

    // After the run everything is still shown, and the page reports that the dashboard has ended.
    training.signal_group(Signal::INT);
    training.wait().with_status(130);
    browser.until(
        "document.querySelector('input[value=second]').closest('li').className === 'stopped'",
    );
    assert_eq!(browser.complaints(), Vec::<String>::new());
    dashboard.signal_group(Signal::INT);
    dashboard.wait().with_status(0);
    browser.until("document.getElementById('connection').className === 'lost'");
}

/// A second run adds a line, a figure, and the configuration keys that differ.
fn compare_with(browser: &Browser, other: &str) {
    assert_eq!(browser.evaluate("document.querySelectorAll('#keys td.differs').length"), 0);
    let chosen = format!("document.querySelector('input[value={other}]').checked");
    assert_eq!(browser.evaluate(&chosen), false, "only running runs are shown at first");
    browser.click(&format!("input[value={other}]"));
    // Charts outside the view are not drawn.
    browser.evaluate("document.querySelector('figure[data-key=return_mean]').scrollIntoView()");
    browser.until(TWO_LINES);
    browser.until(&draws("return_mean", [0x00, 0x72, 0xb2]));
    browser.until(&draws("return_mean", [0x00, 0x9e, 0x73]));
    let keys = "[...document.querySelectorAll('#keys tbody th')].map((one) => one.textContent)";
    browser.until(&format!("{keys}.includes('run.seed')"));
    browser.until(&format!("{keys}.includes('algorithm.name')"));
    browser.until(&format!("!{keys}.includes('algorithm.batch_size')"));
    let processes = "[...document.querySelectorAll('#workers tbody th')]";
    browser.evaluate(
        "(() => { const select = document.getElementById('details-run'); \
         select.value = 'second'; select.dispatchEvent(new Event('change')); })()",
    );
    browser.until(&format!("{processes}.some((one) => one.textContent === 'actor-0')"));
}

/// The same address on a phone: the same view, without horizontal scrolling.
fn look_on_a_phone(browser: &Browser) {
    let view = browser.evaluate("location.href");
    browser.resize(PHONE, true);
    browser.open("about:blank");
    browser.open(view.as_str().unwrap());
    browser.until(
        "(() => { const chart = document.querySelector('figure[data-key=return_mean]'); \
         chart?.scrollIntoView(); return Boolean(chart) && !chart.hidden; })()",
    );
    browser.until(TWO_LINES);
    browser.until("document.querySelectorAll('#keys tbody tr').length > 1");
    let width = browser.evaluate("document.documentElement.scrollWidth");
    assert_eq!(width, PHONE, "the page is wider than the phone");
    assert_eq!(browser.evaluate("document.querySelector('input[value=wall_s]').checked"), true);
}
