"""A neighbour on the network: tries a server from there, and tells what came of each attempt as a line of JSON."""

import json
import os
import socket
import ssl
import subprocess
import sys
import time
import warnings

warnings.simplefilter("ignore")
asked = json.loads(sys.argv[1])
host, port = asked["host"], asked["port"]
PATIENCE = float(os.environ["STORY_PATIENCE"])
address = f"{host}:{port}"


def tell(name, came):
    print(json.dumps({"name": name, "came": came}), flush=True)


def context(change=lambda context: None):
    made = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    made.check_hostname = False
    made.verify_mode = ssl.CERT_NONE
    change(made)
    return made


def plain():
    connection = socket.create_connection((host, port), PATIENCE)
    connection.settimeout(PATIENCE)
    return connection


def heard(connection):
    """All that comes, as far as it matters."""
    said = b""
    try:
        while len(said) < 1 << 20:
            more = connection.recv(1 << 16)
            if not more:
                break
            said += more
    except TimeoutError:
        return b"silence"
    except OSError:
        pass
    return said


def request(method, path, headers=(), body=""):
    lines = [f"{method} {path} HTTP/1.1", "Connection: close", f"Content-Length: {len(body)}"]
    if not any(name.lower() == "host" for name, _ in headers):
        lines.append(f"Host: {address}")
    lines += [f"{name}: {value}" for name, value in headers]
    return ("\r\n".join(lines) + "\r\n\r\n" + body).encode()


def status(said):
    words = said.split(b" ", 2)
    return words[1].decode() if said.startswith(b"HTTP/") and len(words) > 1 else said[:40].hex() or "ended"


def through(sent, change=lambda context: None, name="localhost"):
    """What a server answers through TLS: a status, or how it came to none."""
    try:
        with context(change).wrap_socket(plain(), server_hostname=name) as connection:
            connection.sendall(sent)
            return status(heard(connection))
    except (OSError, ValueError) as error:
        return f"refused: {getattr(error, 'reason', None) or error}"


# Every address, by nobody, by one who guesses, and in plain text.
for method, path in asked["routes"]:
    tell(f"{method} {path}", through(request(method, path)))
    with plain() as connection:
        connection.sendall(request(method, path, [("Authorization", f"Bearer {asked['token']}")]))
        tell(f"plain {method} {path}", status(heard(connection)))

GET = request("GET", "/api/v1/tokens")
for header in ["X-Forwarded-For: 127.0.0.1", "Forwarded: for=127.0.0.1;proto=https", "X-Real-IP: 127.0.0.1", "Host: localhost",
               "Host: 127.0.0.1", "X-Client-Cert: rover1", "X-SSL-Client-S-DN: CN=robot:rover1", "Origin: http://localhost"]:
    tell(f"header {header}", through(request("GET", "/api/v1/tokens", [tuple(header.split(": ", 1))])))


# Certificates of others: each was made by the story.
for name, files in asked["certificates"].items():
    tell(f"certificate {name}", through(GET, lambda context, files=files: context.load_cert_chain(*files)))


# Versions and ciphers that are broken.
def version(which):
    def change(made):
        made.set_ciphers("ALL:@SECLEVEL=0")
        made.minimum_version = made.maximum_version = which
    return change


for which in [ssl.TLSVersion.SSLv3, ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1]:
    tell(f"version {which.name}", through(GET, version(which)))


def ciphers(names):
    def change(made):
        made.maximum_version = ssl.TLSVersion.TLSv1_2
        made.set_ciphers(names)
    return change


for names in ["aNULL:@SECLEVEL=0", "eNULL:@SECLEVEL=0", "3DES:@SECLEVEL=0", "AES128-SHA:@SECLEVEL=0", "ECDHE-RSA-AES128-SHA:@SECLEVEL=0",
              "DHE-RSA-AES128-GCM-SHA256:@SECLEVEL=0", "PSK:@SECLEVEL=0"]:
    tell(f"ciphers {names}", through(GET, ciphers(names)))


# Names and protocols that it does not have: who asks is nobody all the same.
for name in ["evil.example", "localhost.evil.example", "x" * 60 + ".example", "xn--nxasmq6b", host]:
    tell(f"name {name}", through(GET, name=name))
for protocols in [["h2"], ["h2", "http/1.1"], ["http/1.0"], ["x" * 200], ["acme-tls/1"]]:
    tell(f"protocols {protocols}", through(GET, lambda context, protocols=protocols: context.set_alpn_protocols(protocols)))


# What is no handshake, or asks for more than one.
for name, sent in [
    ("nothing of TLS", bytes(range(256)) * 4),
    ("an empty record", b"\x16\x03\x01\x00\x00"),
    ("a record that is too long", b"\x16\x03\x03\xff\xff" + b"\x01" * 70000),
    ("a heartbeat", b"\x18\x03\x02\x00\x03\x01\x40\x00"),
    ("an alert", b"\x15\x03\x03\x00\x02\x02\x28"),
    ("data before a handshake", b"\x17\x03\x03\x00\x10" + b"x" * 16),
    ("a handshake of SSL 2", b"\x80\x2e\x01\x00\x02\x00\x15\x00\x00\x00\x10" + b"\x07\x00\xc0" * 7 + b"x" * 16),
    ("an upgrade to TLS", b"OPTIONS * HTTP/1.1\r\nHost: x\r\nUpgrade: TLS/1.2\r\nConnection: Upgrade, close\r\n\r\n"),
]:
    with plain() as connection:
        try:
            connection.sendall(sent)
            connection.shutdown(socket.SHUT_WR)
        except OSError:
            pass
        tell(f"bytes {name}", status(heard(connection)))
renegotiated = subprocess.run(
    ["openssl", "s_client", "-connect", address, "-tls1_2", "-legacy_renegotiation"], input=b"R\n" + GET,
    stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=PATIENCE, check=False).stdout
tell("renegotiation", "200" if b"HTTP/1.1 200" in renegotiated else "ended")

# One who begins many handshakes, and goes no further, keeps nobody else out: this is asked by the server's own machine.
silent = []
for number in range(300):
    try:
        silent.append(plain())
        if number % 2:
            silent[-1].sendall(b"\x16\x03\x01\x02\x00\x01\x00")
    except OSError:
        pass
others = subprocess.run(
    ["nsenter", "--net", "--target", str(os.getppid()), "curl", "--silent", "--insecure", "--max-time", str(int(PATIENCE)), "--output", "/dev/null",
     "--write-out", "%{http_code}", f"https://{address}/healthz"], stdout=subprocess.PIPE, timeout=2 * PATIENCE, check=False).stdout.decode()
tell("health for others beside half-open handshakes", others)
for connection in silent:
    connection.close()
# Its own next ones are let in when the server has seen that these are over.
until = time.monotonic() + PATIENCE
while through(request("GET", "/healthz")) != "200" and time.monotonic() < until:
    pass

# Codes, passwords and tokens that are guessed: slowed before many were looked at.
for name, path, headers, body in [
    ("codes", "/api/v1/pair", [], lambda number: {"robot": "rover1", "code": f"{number:026d}", "request": "x"}),
    ("passwords", "/api/v1/session", [], lambda number: {"name": "alice", "password": f"guess number {number}"}),
    ("tokens", "/api/v1/tokens", True, lambda number: {}),
]:
    came = []
    for number in range(40):
        shown = [("Authorization", f"Bearer guess{number}")] if headers else []
        came.append(through(request("POST", path, shown, json.dumps(body(number)))))
        if came[-1] == "429":
            break
    tell(f"guesses of {name}", came[-1] if set(came) <= {"401", "429"} else str(came))
