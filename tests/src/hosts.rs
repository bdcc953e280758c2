//! Hosts for a test: network namespaces with their own addresses, and the network between them.
//!
//! Each namespace has one interface, a TUN device. A thread of this process is the wire: it reads
//! IP packets from one device and writes them to another, with a delay, or drops them. The test
//! thus sets delay, loss and failed links, from a seed, without a queueing discipline of the
//! kernel. A namespace ends with its last process, so nothing is left behind.
use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::net::Ipv4Addr;
use std::os::fd::AsRawFd;
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// First bytes of the addresses 10.203.0.1, 10.203.0.2, …, which exist only in the namespaces.
const NETWORK: [u8; 3] = [10, 203, 0];
/// Largest packet [bytes], as within a rack. Larger packets cost the wire less processor time.
const PACKET_BYTES_MAX: i32 = 9_000;
/// Length of a device's queue [packets]. TUN drops further packets silently.
const QUEUE_PACKETS_MAX: i32 = 32_768;
/// Buffer of the router [bytes]; it drops further packets.
const UNDER_WAY_BYTES_MAX: usize = 256 << 20;
/// Longest wait before the thread checks whether it must end.
const LOOK: Duration = Duration::from_millis(20);
const PER_MILLION: u64 = 1_000_000;
/// `TUNSETIFF` of linux/if_tun.h.
const TUNSETIFF: libc::c_ulong = 0x4004_54ca;

/// Behaviour of the wire.
#[derive(Debug, Default)]
struct Wire {
    over: AtomicBool,
    delay_us: AtomicU64,
    loss_per_million: AtomicU64,
    /// Hosts that are cut off, one bit each.
    down: AtomicU64,
    carried: AtomicU64,
    lost: AtomicU64,
}

/// Hosts and the network between them.
#[derive(Debug)]
pub struct Hosts {
    namespaces: Vec<File>,
    wire: Arc<Wire>,
    thread: Option<JoinHandle<()>>,
}

impl Hosts {
    /// Makes this many hosts, on a wire without delay and loss. `tcp_bytes_max` is the maximum size
    /// of a connection's buffers.
    ///
    /// # Errors
    /// This process may not make namespaces or TUN devices.
    pub fn new(count: usize, tcp_bytes_max: usize, seed: u64) -> io::Result<Self> {
        let made: Vec<(File, File)> =
            (0..count).map(|index| host(index, tcp_bytes_max)).collect::<io::Result<_>>()?;
        let (namespaces, tuns): (Vec<_>, Vec<_>) = made.into_iter().unzip();
        let wire = Arc::new(Wire::default());
        let carrying = Arc::clone(&wire);
        let random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let thread = thread::spawn(move || carry(&carrying, tuns, random));
        Ok(Self { namespaces, wire, thread: Some(thread) })
    }

    /// Returns the address of a host.
    pub fn address(&self, host: usize) -> Ipv4Addr {
        address(host)
    }

    /// Makes a command run on a host.
    pub fn place(&self, host: usize, command: &mut Command) {
        let namespace = self.namespaces[host].as_raw_fd();
        let enter = move || match unsafe { libc::setns(namespace, libc::CLONE_NEWNET) } {
            0 => Ok(()),
            _ => Err(io::Error::last_os_error()),
        };
        // SAFETY: between fork and exec the closure makes one system call with a plain number; the
        // descriptor is open, as this outlives the command's start.
        unsafe { command.pre_exec(enter) };
    }

    /// Sets the delay in each direction.
    pub fn delay(&self, delay: Duration) {
        self.wire.delay_us.store(delay.as_micros() as u64, Ordering::Release);
    }

    /// Sets the share of packets that are lost.
    pub fn lose(&self, share: f64) {
        let per_million = (share * PER_MILLION as f64) as u64;
        self.wire.loss_per_million.store(per_million, Ordering::Release);
    }

    /// Cuts a host off, or reconnects it.
    pub fn cut(&self, host: usize, is_down: bool) {
        let bit = 1 << host;
        match is_down {
            true => self.wire.down.fetch_or(bit, Ordering::AcqRel),
            false => self.wire.down.fetch_and(!bit, Ordering::AcqRel),
        };
    }

    /// Returns the numbers of packets that were carried and lost.
    pub fn counts(&self) -> (u64, u64) {
        (self.wire.carried.load(Ordering::Acquire), self.wire.lost.load(Ordering::Acquire))
    }
}

impl Drop for Hosts {
    fn drop(&mut self) {
        self.wire.over.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn address(host: usize) -> Ipv4Addr {
    let [a, b, c] = NETWORK;
    Ipv4Addr::new(a, b, c, u8::try_from(host + 1).expect("fewer than 255 hosts"))
}

/// Makes a namespace and its TUN device, in a thread that enters the namespace and ends.
fn host(index: usize, tcp_bytes_max: usize) -> io::Result<(File, File)> {
    let make = move || -> io::Result<(File, File)> {
        // SAFETY: changes only the network of this thread, which then ends.
        if unsafe { libc::unshare(libc::CLONE_NEWNET) } != 0 {
            return Err(io::Error::last_os_error());
        }
        let namespace = File::open("/proc/thread-self/ns/net")?;
        for (name, smallest, usual) in [("tcp_rmem", 4_096, 131_072), ("tcp_wmem", 4_096, 65_536)] {
            let sizes = format!("{smallest} {usual} {tcp_bytes_max}");
            fs::write(format!("/proc/thread-self/net/../../sys/net/ipv4/{name}"), &sizes)
                .or_else(|_| fs::write(format!("/proc/sys/net/ipv4/{name}"), &sizes))?;
        }
        let tun = tun_device(address(index))?;
        Ok((namespace, tun))
    };
    thread::spawn(make).join().expect("the thread does not panic")
}

/// Opens an interface of this thread's namespace, sets its address, and brings it up.
fn tun_device(address: Ipv4Addr) -> io::Result<File> {
    let mut options = OpenOptions::new();
    let tun = options
        .read(true)
        .write(true)
        .custom_flags(libc::O_NONBLOCK | libc::O_CLOEXEC)
        .open("/dev/net/tun")?;
    let mut request = interface("wire0");
    request.ifr_ifru.ifru_flags = (libc::IFF_TUN | libc::IFF_NO_PI) as libc::c_short;
    control(tun.as_raw_fd(), TUNSETIFF, &mut request)?;
    let socket = std::net::UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    let socket = socket.as_raw_fd();
    let with = |operation, change: &dyn Fn(&mut libc::ifreq)| {
        let mut request = interface("wire0");
        change(&mut request);
        control(socket, operation, &mut request)
    };
    with(libc::SIOCSIFMTU, &|request| request.ifr_ifru.ifru_mtu = PACKET_BYTES_MAX)?;
    with(libc::SIOCSIFADDR, &|request| request.ifr_ifru.ifru_addr = socket_address(address))?;
    with(libc::SIOCSIFTXQLEN, &|request| request.ifr_ifru.ifru_metric = QUEUE_PACKETS_MAX)?;
    let mask = Ipv4Addr::new(255, 255, 255, 0);
    with(libc::SIOCSIFNETMASK, &|request| request.ifr_ifru.ifru_netmask = socket_address(mask))?;
    let up = (libc::IFF_UP | libc::IFF_RUNNING) as libc::c_short;
    with(libc::SIOCSIFFLAGS, &|request| request.ifr_ifru.ifru_flags = up)?;
    let mut loopback = interface("lo");
    loopback.ifr_ifru.ifru_flags = up;
    control(socket, libc::SIOCSIFFLAGS, &mut loopback)?;
    Ok(tun)
}

fn interface(name: &str) -> libc::ifreq {
    // SAFETY: the struct consists of plain numbers, for which zero is valid.
    let mut request: libc::ifreq = unsafe { std::mem::zeroed() };
    for (to, from) in request.ifr_name.iter_mut().zip(name.bytes()) {
        *to = from as libc::c_char;
    }
    request
}

fn socket_address(address: Ipv4Addr) -> libc::sockaddr {
    let octets = address.octets();
    let mut data = [0; 14];
    for (to, from) in data[2..].iter_mut().zip(octets) {
        *to = from as libc::c_char;
    }
    libc::sockaddr { sa_family: libc::AF_INET as libc::sa_family_t, sa_data: data }
}

fn control(descriptor: i32, operation: libc::c_ulong, request: &mut libc::ifreq) -> io::Result<()> {
    // SAFETY: the kernel reads and writes one `ifreq`, which lives as long as the call.
    match unsafe { libc::ioctl(descriptor, operation as _, request) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// A packet in transit.
struct Packet {
    due: Instant,
    to: usize,
    bytes: Vec<u8>,
    len: usize,
}

fn await_packets(tuns: &[File], wait: Duration) {
    let of = |tun: &File| libc::pollfd { fd: tun.as_raw_fd(), events: libc::POLLIN, revents: 0 };
    let mut all: Vec<libc::pollfd> = tuns.iter().map(of).collect();
    let timeout = libc::timespec { tv_sec: 0, tv_nsec: wait.as_nanos() as libc::c_long };
    // SAFETY: the kernel reads and writes as many descriptors as there are, and reads the timeout.
    unsafe { libc::ppoll(all.as_mut_ptr(), all.len() as u64, &timeout, std::ptr::null()) };
}

/// Carries packets until `over` is set.
fn carry(wire: &Wire, mut tuns: Vec<File>, mut random: Xoshiro256PlusPlus) {
    let mut under_way: VecDeque<Packet> = VecDeque::new();
    let mut under_way_bytes = 0;
    // Reused, because the wire shares the processor with the measured program.
    let mut free: Vec<Vec<u8>> = Vec::new();
    while !wire.over.load(Ordering::Acquire) {
        let now = Instant::now();
        let wait = under_way.front().map_or(LOOK, |first| first.due.saturating_duration_since(now));
        await_packets(&tuns, wait.min(LOOK));
        for from in 0..tuns.len() {
            loop {
                let mut bytes = free.pop().unwrap_or_else(|| vec![0; PACKET_BYTES_MAX as usize]);
                let Ok(len) = tuns[from].read(&mut bytes) else {
                    free.push(bytes);
                    break;
                };
                let to = receiver(wire, from, tuns.len(), &bytes[..len]);
                let loss = wire.loss_per_million.load(Ordering::Acquire);
                let is_lost = random.random_range(0..PER_MILLION) < loss;
                let full = under_way_bytes + len > UNDER_WAY_BYTES_MAX;
                let Some(to) = to.filter(|_| !is_lost && !full) else {
                    wire.lost.fetch_add(1, Ordering::AcqRel);
                    free.push(bytes);
                    continue;
                };
                let delay = Duration::from_micros(wire.delay_us.load(Ordering::Acquire));
                under_way_bytes += len;
                under_way.push_back(Packet { due: Instant::now() + delay, to, bytes, len });
            }
        }
        while under_way.front().is_some_and(|first| first.due <= Instant::now()) {
            let Some(Packet { to, bytes, len, .. }) = under_way.pop_front() else { break };
            under_way_bytes -= len;
            // A full queue of the kernel drops a packet too.
            match tuns[to].write(&bytes[..len]) {
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    wire.lost.fetch_add(1, Ordering::AcqRel);
                }
                _ => drop(wire.carried.fetch_add(1, Ordering::AcqRel)),
            }
            free.push(bytes);
        }
    }
}

/// Returns the destination of a packet if it is one of our hosts and neither end is cut off.
fn receiver(wire: &Wire, from: usize, hosts: usize, packet: &[u8]) -> Option<usize> {
    let is_ours = packet.len() >= 20 && packet[0] >> 4 == 4 && packet[16..19] == NETWORK;
    let to = usize::from(packet.get(19)?.checked_sub(1)?);
    let down = wire.down.load(Ordering::Acquire);
    (is_ours && to < hosts && (down >> from | down >> to) & 1 == 0).then_some(to)
}
