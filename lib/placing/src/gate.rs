//! Which requests are answered at all.
//!
//! Other pages of the same browser can send requests here, and other names can be made to point at
//! this machine. So a request must carry the token in its address, name this server as its host, and
//! come from no other origin. Its address is compared with a list, and never becomes a path.
use std::fmt;

use constant_time_eq::constant_time_eq;

/// A reason to answer with an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// Of HTTP.
    pub status: u16,
    /// One sentence.
    pub message: &'static str,
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.message)
    }
}

/// What a request says before its body.
#[derive(Clone, Copy, Debug, Default)]
pub struct Head<'a> {
    /// `GET` or another.
    pub method: &'a str,
    /// The address, from the first slash on.
    pub url: &'a str,
    /// The header of that name.
    pub host: Option<&'a str>,
    /// The header of that name.
    pub origin: Option<&'a str>,
    /// Bytes of the body, if it says so.
    pub length: Option<usize>,
    /// Whether the body comes in pieces of unknown number.
    pub is_chunked: bool,
}

/// A way into the program.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Route {
    /// Behind the token.
    pub path: &'static str,
    /// Whether it takes a body, by `POST`.
    pub posts: bool,
}

/// Most bytes of a body of JSON.
pub const MOST_JSON: usize = 1 << 20;

/// Who may come in.
#[derive(Clone, Debug)]
pub struct Gate {
    /// `127.0.0.1:PORT`.
    pub authority: String,
    /// The secret of the address.
    pub token: String,
    /// Most bytes of a painted mask.
    pub mask_bytes: usize,
}

/// The route of masks, whose size depends on the photograph.
pub const MASK: &str = "mask";

impl Gate {
    /// The one of `routes` that is asked for.
    ///
    /// # Errors
    /// If it is not to be answered.
    pub fn admit(&self, head: &Head, routes: &[Route]) -> Result<Route, Refusal> {
        let refuse = |status, message| Err(Refusal { status, message });
        if head.host != Some(&self.authority) {
            return refuse(403, "this server answers to its own address alone");
        }
        if !["GET", "POST"].contains(&head.method) {
            return refuse(405, "this is asked for in another way");
        }
        let own = format!("http://{}", self.authority);
        match head.origin {
            Some(origin) if origin != own => {
                return refuse(403, "another page may not ask this server");
            }
            None if head.method != "GET" => {
                return refuse(
                    403,
                    "a request that changes something says where it comes from",
                );
            }
            _ => {}
        }
        let mut parts = head.url.splitn(3, '/').skip(1);
        let token = parts.next().unwrap_or_default();
        if !constant_time_eq(token.as_bytes(), self.token.as_bytes()) {
            return refuse(
                403,
                "the address lacks its token: open the one that dipir place printed",
            );
        }
        let path = parts.next().unwrap_or("?");
        let Some(route) = routes.iter().find(|r| r.path == path) else {
            return refuse(404, "there is nothing of that name");
        };
        let method = if route.posts { "POST" } else { "GET" };
        if head.method != method {
            return refuse(405, "this is asked for in another way");
        }
        let most = match route.posts {
            false => 0,
            true if route.path == MASK => self.mask_bytes,
            true => MOST_JSON,
        };
        match head.length {
            _ if head.is_chunked => refuse(411, "the body does not say how long it is"),
            None if route.posts => refuse(411, "the body does not say how long it is"),
            Some(length) if length > most => refuse(413, "the body is too long"),
            _ => Ok(*route),
        }
    }
}

/// A secret that cannot be guessed: 128 bits in hexadecimal.
///
/// # Errors
/// If the system has no random numbers.
pub fn token() -> anyhow::Result<String> {
    let mut bytes = [0u8; 16];
    getrandom::fill(&mut bytes)
        .map_err(|e| anyhow::anyhow!("the system gives no random numbers: {e}"))?;
    Ok(bytes.iter().map(|b| format!("{b:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROUTES: [Route; 3] = [
        Route {
            path: "",
            posts: false,
        },
        Route {
            path: "save",
            posts: true,
        },
        Route {
            path: MASK,
            posts: true,
        },
    ];

    fn gate() -> Gate {
        Gate {
            authority: "127.0.0.1:4000".into(),
            token: "secret".into(),
            mask_bytes: 50,
        }
    }

    fn status(head: Head) -> u16 {
        gate()
            .admit(&head, &ROUTES)
            .map_or_else(|r| r.status, |_| 200)
    }

    const GET: Head = Head {
        method: "GET",
        url: "/secret/",
        host: Some("127.0.0.1:4000"),
        origin: None,
        length: None,
        is_chunked: false,
    };
    const POST: Head = Head {
        method: "POST",
        url: "/secret/save",
        origin: Some("http://127.0.0.1:4000"),
        length: Some(10),
        ..GET
    };

    #[test]
    fn who_knows_the_address_comes_in() {
        assert_eq!((status(GET), status(POST)), (200, 200));
    }

    #[test]
    fn other_hosts_origins_tokens_and_paths_are_refused() {
        for (url, expected) in [
            ("/", 403),
            ("", 403),
            ("/secre/", 403),
            ("/secrets/", 403),
            ("/secret", 404),
            ("/secret/../../etc/passwd", 404),
            ("/secret/%2e%2e/pipeline.toml", 404),
            ("/secret/?a", 404),
        ] {
            assert_eq!(status(Head { url, ..GET }), expected, "{url}");
        }
        for host in [
            None,
            Some("evil.example"),
            Some("127.0.0.1:4001"),
            Some("localhost:4000"),
        ] {
            assert_eq!(status(Head { host, ..GET }), 403);
        }
        for origin in [
            Some("http://evil.example"),
            Some("null"),
            Some("https://127.0.0.1:4000"),
        ] {
            assert_eq!(status(Head { origin, ..GET }), 403);
            assert_eq!(status(Head { origin, ..POST }), 403);
        }
        assert_eq!(
            status(Head {
                origin: None,
                ..POST
            }),
            403
        );
        for method in ["PUT", "HEAD", "OPTIONS", "TRACE", ""] {
            assert_eq!(status(Head { method, ..GET }), 405, "{method}");
            assert_eq!(status(Head { method, ..POST }), 405, "{method}");
        }
        assert_eq!(
            status(Head {
                method: "POST",
                url: "/secret/",
                ..POST
            }),
            405
        );
    }

    #[test]
    fn long_bodies_are_refused_before_they_are_read() {
        let long = |url, length| {
            status(Head {
                url,
                length,
                ..POST
            })
        };
        assert_eq!(long("/secret/save", Some(100 << 20)), 413);
        assert_eq!(long("/secret/save", None), 411);
        assert_eq!(long("/secret/mask", Some(50)), 200);
        assert_eq!(long("/secret/mask", Some(51)), 413);
        let chunked = Head {
            is_chunked: true,
            ..POST
        };
        assert_eq!(status(chunked), 411);
    }

    #[test]
    fn tokens_differ() {
        let (a, b) = (token().unwrap(), token().unwrap());
        assert!(a != b && a.len() == 32);
    }
}
