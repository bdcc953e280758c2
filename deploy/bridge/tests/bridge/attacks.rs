//! Attacks on a run's port. A session with the gateway needs the run's token. Most attackers here
//! have one nevertheless, so that each later check is tested by itself.

use std::io::Write;
use std::net::TcpStream;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use dmprl_bridge::handshake::{Authenticator, HostMessage, join_key, read_answer};
use dmprl_bridge::host_messages::{HostAnswer, HostRequest, HostStatus, HostWelcome, Lease};
use dmprl_bridge::join::{Admission, JoinOutcome, JoinSettings, explain_silence, request_join};
use dmprl_bridge::seal::Sealer;
use dmprl_bridge::{Link, LinkMode, Urgency};
use dmprl_shared::transport::shared_memory::Domain;

use super::{
    FIRST, LAYOUT, PATIENCE, POLL, SEGMENTS, Stage, WORKERS, endpoint, facts, join_settings,
    learner, open_gateway,
};

const JOIN: &str = "dmprl/join";
const ANOTHER_TOKEN: &str = "another secret of some length";
/// Time limit for one answer.
const ANSWER: Duration = Duration::from_secs(3);

/// A running gateway and its reports.
struct Attacked {
    stage: Arc<Stage>,
    endpoint: String,
    news: Arc<Mutex<Vec<String>>>,
    threads: [JoinHandle<()>; 2],
    _folder: tempfile::TempDir,
}

impl Attacked {
    fn start(protocol: &str) -> Self {
        Self::at(endpoint(protocol))
    }

    fn at(endpoint: String) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let domain = Domain::create(&folder.path().join("p"), "a").unwrap();
        let (stage, news) = (Stage::new(LAYOUT, WORKERS, SEGMENTS), Arc::default());
        let threads = [
            {
                let (stage, path) = (Arc::clone(&stage), domain.path().to_owned());
                thread::spawn(move || learner(&stage, path))
            },
            {
                let (stage, news) = (Arc::clone(&stage), Arc::clone(&news));
                let (endpoint, path) = (endpoint.clone(), domain.path().to_owned());
                thread::spawn(move || gateway(&stage, &news, path, endpoint, domain))
            },
        ];
        Self { stage, endpoint, news, threads, _folder: folder }
    }

    fn link(&self, token: &str) -> Link {
        Link::open(LinkMode::Connect(&self.endpoint), token, None).unwrap()
    }

    fn rejected(&self) -> u64 {
        self.stage.refused.load(Ordering::Acquire)
    }

    /// Ends it. Returns its notices and its final list of hosts.
    fn end(self) -> String {
        self.stage.over.store(true, Ordering::Release);
        self.threads.into_iter().for_each(|thread| thread.join().unwrap());
        self.news.lock().unwrap().join("\n")
    }
}

fn gateway(
    stage: &Stage,
    news: &Mutex<Vec<String>>,
    path: PathBuf,
    endpoint: String,
    _domain: Domain,
) {
    let mut gateway = open_gateway(stage, &path, &[endpoint]);
    while !stage.is_over() {
        gateway.turn().unwrap();
        let events = gateway.take_events();
        news.lock().unwrap().extend(events.iter().map(|event| format!("{event:?}")));
        stage.refused.store(gateway.rejected(), Ordering::Release);
        thread::sleep(POLL);
    }
    let hosts = gateway.hosts();
    news.lock().unwrap().extend(hosts.iter().map(|host| format!("at the end: {}", host.name)));
}

/// Requests until the answer is final.
fn joined(link: &Link, settings: &JoinSettings, lease: Option<Lease>) -> JoinOutcome {
    let deadline = Instant::now() + PATIENCE;
    loop {
        match request_join(link, settings, lease).unwrap() {
            JoinOutcome::Later(_) | JoinOutcome::Silent => assert!(Instant::now() < deadline),
            answer => return answer,
        }
    }
}

fn admitted(link: &Link, settings: &JoinSettings) -> Box<Admission> {
    match joined(link, settings, None) {
        JoinOutcome::Welcome(admission) => admission,
        other => panic!("{other:?}"),
    }
}

/// Sends a message of the handshake. Returns its answer, if it is proven.
fn ask(link: &Link, message: &HostMessage) -> Option<HostAnswer> {
    let (key, payload) = (join_key(&facts().token), serde_json::to_vec(message).unwrap());
    let accept = |answer: &[u8]| read_answer(&key, &payload, answer);
    let received = link.request(JOIN, payload.clone(), ANSWER, accept).unwrap();
    received.map(|received| received.answer)
}

fn challenge(link: &Link) -> String {
    let deadline = Instant::now() + PATIENCE;
    while Instant::now() < deadline {
        if let Some(HostAnswer::Challenge(it)) = ask(link, &HostMessage::hello().unwrap()) {
            return it;
        }
    }
    panic!("no challenge");
}

fn request(host: u64, lease: Option<Lease>) -> HostRequest {
    HostRequest { host, name: "b".into(), workers: WORKERS as u32, sealed: true, lease }
}

#[test]
fn hosts_need_the_token_to_connect_whatever_the_protocol() {
    for protocol in ["tcp", "tls"] {
        let attacked = Attacked::start(protocol);
        let right = join_settings(&attacked.endpoint, WORKERS);
        admitted(&attacked.link(&right.token), &right);
        let wrong = JoinSettings { token: ANOTHER_TOKEN.into(), ..right };
        let link = attacked.link(ANOTHER_TOKEN);
        let deadline = Instant::now() + ANSWER;
        while Instant::now() < deadline {
            let outcome = request_join(&link, &wrong, None).unwrap();
            assert!(matches!(outcome, JoinOutcome::Silent), "{outcome:?}");
        }
        let reason = explain_silence(&attacked.endpoint);
        assert!(reason.contains("bridge.token"), "{reason}");
        let reason = explain_silence(&endpoint(protocol));
        assert!(!reason.contains("bridge.token"), "{reason}");
        assert_eq!(attacked.end().matches("takes part").count(), 1);
    }
}

#[test]
fn hosts_of_another_version_and_too_many_workers_are_told_what_to_do() {
    let attacked = Attacked::start("tls");
    let right = join_settings(&attacked.endpoint, WORKERS);
    let link = attacked.link(&right.token);
    let many = JoinSettings { workers: 99, ..right.clone() };
    let JoinOutcome::Refused(reason) = joined(&link, &many, None) else { panic!("admitted") };
    assert!(reason.contains("bridge.workers_max"), "{reason}");
    admitted(&link, &right);
    let other = serde_json::json!({"speaks": {"version": "9.9.9", "control": 77}, "new": 1});
    let (key, payload) = (join_key(&right.token), serde_json::to_vec(&other).unwrap());
    let accept = |answer: &[u8]| read_answer(&key, &payload, answer);
    let answer = link.request(JOIN, payload.clone(), PATIENCE, accept).unwrap().unwrap().answer;
    let HostAnswer::Refused { reason, later: false } = answer else { panic!("{answer:?}") };
    assert!(reason.contains("9.9.9"), "{reason}");
    assert!(attacked.end().contains("9.9.9"));
}

/// The code that a rogue learner wants a host to run.
fn rogue_welcome() -> HostAnswer {
    HostAnswer::Welcome(Box::new(HostWelcome {
        channel: 1,
        gateway: 2,
        sealed: true,
        lease: Lease { first: FIRST as u32, session: 0 },
        run_id: facts().run_id,
        config: "[task]\nid = \"evil:Evil\"\npython_path = [\"/tmp\"]\n".into(),
        spec: facts().spec,
    }))
}

#[test]
fn learner_that_answers_first_is_not_believed_by_hosts() {
    let endpoint = endpoint("tcp");
    let settings = join_settings(&endpoint, WORKERS);
    let host = Link::open(LinkMode::Connect(&endpoint), &settings.token, None).unwrap();
    let endpoints = [endpoint.clone()];
    let rogue = Link::open(LinkMode::Listen(&endpoints), &settings.token, None).unwrap();
    let requests = rogue.requests(JOIN).unwrap();
    let stranger = Authenticator::new(ANOTHER_TOKEN).unwrap();
    let outcome = thread::scope(|scope| {
        let asking = scope.spawn(|| {
            let deadline = Instant::now() + ANSWER;
            let mut outcomes = Vec::new();
            while Instant::now() < deadline {
                outcomes.push(request_join(&host, &settings, None).unwrap());
            }
            outcomes
        });
        let mut answered = 0;
        while !asking.is_finished() {
            let Some(request) = requests.next().unwrap() else {
                thread::sleep(POLL);
                continue;
            };
            // Without a proof, and with one of another token.
            answered += 1;
            let bare = serde_json::to_vec(&rogue_welcome()).unwrap();
            let forged = stranger.answer(&request.bytes(), &rogue_welcome()).unwrap().0;
            request.answer(if answered % 2 == 0 { bare } else { forged }).unwrap();
        }
        assert!(answered > 1, "the host asked the rogue");
        asking.join().unwrap()
    });
    let silent = |outcome: &JoinOutcome| matches!(outcome, JoinOutcome::Silent);
    assert!(outcome.iter().all(silent), "{outcome:?}");
    drop((requests, rogue));
    // The same session of the host reaches the real learner afterwards.
    let attacked = Attacked::at(endpoint);
    assert_eq!(admitted(&host, &settings).welcome.config, facts().config);
    attacked.end();
}

#[test]
fn replays_and_guessed_places_get_hosts_nothing() {
    let attacked = Attacked::start("tcp");
    let token = facts().token;
    let link = attacked.link(&token);
    let (right, stranger) = (join_key(&token), join_key(ANOTHER_TOKEN));
    let deadline = Instant::now() + PATIENCE;
    let genuine = loop {
        let message = HostMessage::join(&right, challenge(&link), &request(1, None)).unwrap();
        match ask(&link, &message) {
            Some(HostAnswer::Welcome(_)) => break message,
            Some(HostAnswer::Refused { later: true, .. }) | None => {
                assert!(Instant::now() < deadline);
            }
            other => panic!("{other:?}"),
        }
    };
    let refused = |message: &HostMessage| match ask(&link, message) {
        Some(HostAnswer::Refused { .. }) => {}
        other => panic!("{other:?}"),
    };
    refused(&genuine);
    // A guessed lease, and another host's number.
    for lease in [None, Some(Lease { first: FIRST as u32, session: 0 })] {
        refused(&HostMessage::join(&stranger, challenge(&link), &request(1, lease)).unwrap());
    }
    // The request of a host to an earlier gateway.
    refused(&HostMessage::join(&right, "0".repeat(64), &request(2, None)).unwrap());
    let news = attacked.end();
    assert_eq!(news.matches("takes part").count(), 1, "{news}");
    assert_eq!(news.matches("at the end").count(), 1, "{news}");
    assert!(news.contains("rejected a host"), "{news}");
}

/// Sends a message and waits until the gateway has rejected it.
fn until_rejected(attacked: &Attacked, send: impl FnOnce()) {
    let before = attacked.rejected();
    send();
    attacked.stage.until("a rejected message", || attacked.rejected() > before);
}

#[test]
fn hosts_cannot_speak_with_the_name_of_another() {
    let attacked = Attacked::start("tcp");
    let settings = join_settings(&attacked.endpoint, 1);
    let link = attacked.link(&settings.token);
    let victim = admitted(&link, &settings);
    let attacker = JoinSettings { host: 2, name: "attacker".into(), ..settings.clone() };
    let attacker = admitted(&link, &attacker);
    let name = |kind: &str, channel: u64| format!("dmprl/{}/{kind}/{channel:016x}", facts().run_id);
    let leaves = HostStatus { leaves: true, ..HostStatus::default() };
    let leaves = serde_json::to_vec(&leaves).unwrap();
    let status = link.sender(name("status", victim.welcome.channel), Urgency::First).unwrap();
    // Without a keyed hash, with the one of another host, and with that of another kind.
    until_rejected(&attacked, || status.send(leaves.clone()).unwrap());
    let forged = Sealer::new(attacker.session.as_ref(), "status").seal(leaves.clone());
    until_rejected(&attacked, || status.send(forged.clone()).unwrap());
    let misplaced = Sealer::new(victim.session.as_ref(), "segments").seal(leaves.clone());
    until_rejected(&attacked, || status.send(misplaced.clone()).unwrap());
    // A replay of the victim's own message.
    let own = serde_json::to_vec(&HostStatus::default()).unwrap();
    let own = Sealer::new(victim.session.as_ref(), "status").seal(own);
    status.send(own.clone()).unwrap();
    until_rejected(&attacked, || status.send(own.clone()).unwrap());
    let segments = link.sender(name("segments", victim.welcome.channel), Urgency::Segments);
    let segments = segments.unwrap();
    until_rejected(&attacked, || segments.send(b"nonsense".to_vec()).unwrap());
    let news = attacked.end();
    assert!(!news.contains("has left"), "{news}");
    assert_eq!(news.matches("at the end").count(), 2, "{news}");
}

/// Channels of an earlier gateway are tolerated for a while, others are counted.
#[test]
fn messages_on_channels_of_no_hosts_are_counted() {
    let attacked = Attacked::start("tls");
    let link = attacked.link(&facts().token);
    let name = "dmprl/0000000000000007/segments/00000000000000aa".to_owned();
    let stranger = link.sender(name, Urgency::Segments).unwrap();
    attacked.stage.until("the stranger's messages counted", || {
        stranger.send(b"nonsense".to_vec()).unwrap();
        attacked.rejected() > 0
    });
    attacked.end();
}

#[test]
fn hosts_join_while_the_port_is_flooded_and_dropped_requests_are_counted() {
    let attacked = Attacked::start("tcp");
    let address = attacked.endpoint.trim_start_matches("tcp/").to_owned();
    let settings = join_settings(&attacked.endpoint, WORKERS);
    let (flooding, large) = (attacked.link(&settings.token), vec![b' '; 1 << 20]);
    challenge(&flooding);
    // Connections that say nothing of the protocol, held open during the test.
    let strangers: Vec<_> = (0..200).filter_map(|_| TcpStream::connect(&address).ok()).collect();
    for mut stranger in &strangers {
        let _ = stranger.write_all(&[0xff; 1_000]);
    }
    for _ in 0..20 {
        let answer = flooding.request(JOIN, large.clone(), ANSWER, |answer| Some(answer.to_vec()));
        assert_eq!(answer.unwrap(), None);
    }
    attacked.stage.until("the requests counted", || attacked.rejected() >= 20);
    admitted(&attacked.link(&settings.token), &settings);
    attacked.end();
}

#[test]
fn requests_of_hosts_wait_in_a_queue_of_limited_length() {
    let endpoints = [endpoint("tcp")];
    let token = facts().token;
    let gateway = Link::open(LinkMode::Listen(&endpoints), &token, None).unwrap();
    // Nothing reads it.
    let requests = gateway.requests(JOIN).unwrap();
    let host = Link::open(LinkMode::Connect(&endpoints[0]), &token, None).unwrap();
    let deadline = Instant::now() + PATIENCE;
    while requests.dropped() == 0 {
        assert!(Instant::now() < deadline);
        let limit = Duration::from_millis(1);
        host.request(JOIN, vec![b' '; 100], limit, |_| None::<()>).unwrap();
    }
    let mut waiting = 0;
    while requests.next().unwrap().is_some() {
        waiting += 1;
    }
    assert_eq!(waiting, 64);
}
