//! Reference of the transport: raw TCP ping-pong between two processes, with the payload sizes of a step.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};

use crate::error::{BenchError, failed};

/// Connection to an echo process, which reads `request` bytes and writes `reply` bytes in a loop.
pub struct PingPong {
    stream: TcpStream,
    request: Vec<u8>,
    reply: Vec<u8>,
    child: Child,
}

impl PingPong {
    /// Starts the echo process and connects to it.
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

    /// Executes one round trip.
    pub fn once(&mut self) -> Result<(), BenchError> {
        self.stream.write_all(&self.request).map_err(failed)?;
        self.stream.read_exact(&mut self.reply).map_err(failed)
    }
}

impl Drop for PingPong {
    fn drop(&mut self) {
        // The echo process stops when the connection is closed.
        let _ = self.stream.shutdown(std::net::Shutdown::Both);
        let _ = self.child.wait();
    }
}

/// Runs the echo process: prints its address and serves one connection until it is closed.
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
