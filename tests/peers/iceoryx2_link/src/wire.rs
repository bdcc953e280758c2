//! A TCP wire on loopback that can be stalled or cut.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use anyhow::Result;

const LOOK: Duration = Duration::from_millis(5);

/// State of the wire.
#[derive(Clone, Copy, PartialEq)]
pub enum Fault {
    /// Nothing passes, and data in transit stays in transit.
    Still,
    /// Connections end, and none is made.
    Cut,
}

#[derive(Default)]
struct State {
    still: AtomicBool,
    cut: AtomicBool,
    ends: Mutex<Vec<TcpStream>>,
}

/// The wire: connects each client of the near end to the listener at the far end.
pub struct Wire {
    near: SocketAddr,
    far: SocketAddr,
    state: Arc<State>,
}

impl Wire {
    /// Opens the near end.
    pub fn lay() -> Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let far = TcpListener::bind("127.0.0.1:0")?.local_addr()?;
        let (near, state) = (listener.local_addr()?, Arc::new(State::default()));
        let accepting = Arc::clone(&state);
        thread::spawn(move || {
            for near in listener.incoming().flatten() {
                // A client that connects too early, or while the wire is cut, tries again.
                if !accepting.cut.load(Ordering::Acquire) {
                    let _ = accepting.join(near, far);
                }
            }
        });
        Ok(Self { near, far, state })
    }

    /// Address to connect to.
    pub fn near_end(&self) -> SocketAddr {
        self.near
    }

    /// Address to listen at.
    pub fn far_end(&self) -> SocketAddr {
        self.far
    }

    /// Schedules a fault after a delay, for a number of seconds.
    pub fn strike(&self, fault: Fault, after: Duration, seconds: f64) {
        let state = Arc::clone(&self.state);
        thread::spawn(move || {
            thread::sleep(after);
            let flag = if fault == Fault::Cut { &state.cut } else { &state.still };
            flag.store(true, Ordering::Release);
            if fault == Fault::Cut {
                let mut ends = state.ends.lock().unwrap_or_else(PoisonError::into_inner);
                for end in ends.drain(..) {
                    let _ = end.shutdown(Shutdown::Both);
                }
            }
            thread::sleep(Duration::from_secs_f64(seconds));
            flag.store(false, Ordering::Release);
        });
    }
}

impl State {
    fn join(self: &Arc<Self>, near: TcpStream, far: SocketAddr) -> Result<()> {
        let far = TcpStream::connect(far)?;
        let mut ends = self.ends.lock().unwrap_or_else(PoisonError::into_inner);
        for (from, to) in [(&near, &far), (&far, &near)] {
            let (from, to, state) = (from.try_clone()?, to.try_clone()?, Arc::clone(self));
            ends.push(from.try_clone()?);
            thread::spawn(move || {
                let _ = state.pass(&from, &to);
                let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
            });
        }
        Ok(())
    }

    fn pass(&self, mut from: &TcpStream, mut to: &TcpStream) -> std::io::Result<()> {
        let mut bytes = vec![0; 65_536];
        loop {
            let read = from.read(&mut bytes)?;
            if read == 0 {
                return Ok(());
            }
            while self.still.load(Ordering::Acquire) {
                thread::sleep(LOOK);
            }
            to.write_all(&bytes[..read])?;
        }
    }
}
