//! The reference: a raw TCP ping-pong between two processes, with the payload sizes of a step.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};

use crate::error::{BenchError, failed};

/// A connection to an echo process: it reads `request` bytes and writes `reply` bytes, again and again.
pub struct PingPong {
    stream: TcpStream,
    request: Vec<u8>,
    reply: Vec<u8>,
    child: Child,
}

impl PingPong {
    /// Starts the other process and connects.
    pub fn start(request: usize, reply: usize) -> Result<Self, BenchError> {
        let mut child = Command::new(std::env::current_exe().map_err(failed)?)
            .args(["bench", "tcp-echo"])
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let mut address = String::new();
        if let Some(stdout) = child.stdout.take() {
            BufReader::new(stdout).read_line(&mut address).map_err(failed)?;
        }
        let mut stream = TcpStream::connect(address.trim()).map_err(failed)?;
        stream.set_nodelay(true).map_err(failed)?;
        for size in [request, reply] {
            stream.write_all(&(size as u64).to_le_bytes()).map_err(failed)?;
        }
        Ok(Self { stream, request: vec![0; request], reply: vec![0; reply], child })
    }

    /// One round trip.
    pub fn once(&mut self) -> Result<(), BenchError> {
        self.stream.write_all(&self.request).map_err(failed)?;
        self.stream.read_exact(&mut self.reply).map_err(failed)
    }
}

impl Drop for PingPong {
    fn drop(&mut self) {
        // The echo ends when the connection does.
        let _ = self.stream.shutdown(std::net::Shutdown::Both);
        let _ = self.child.wait();
    }
}

/// The other end: prints its address, answers one connection, ends with it.
pub fn echo() -> Result<(), BenchError> {
    let listener = TcpListener::bind("127.0.0.1:0").map_err(failed)?;
    println!("{}", listener.local_addr().map_err(failed)?);
    std::io::stdout().flush().map_err(failed)?;
    let (mut stream, _) = listener.accept().map_err(failed)?;
    stream.set_nodelay(true).map_err(failed)?;
    let mut size = || {
        let mut bytes = [0; 8];
        stream.read_exact(&mut bytes).map(|()| u64::from_le_bytes(bytes) as usize)
    };
    let (mut request, reply) = (vec![0; size().map_err(failed)?], vec![0; size().map_err(failed)?]);
    while stream.read_exact(&mut request).is_ok() && stream.write_all(&reply).is_ok() {}
    Ok(())
}
