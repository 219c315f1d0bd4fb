# docker build -t dipir . && docker run --rm -v "$PWD:/work" dipir run
FROM rust:1.95-slim-bookworm AS build
WORKDIR /src
COPY . .
RUN cargo install --locked --path . --root /opt/dipir

FROM debian:bookworm-slim
COPY --from=build /opt/dipir/bin/ /usr/local/bin/
COPY --from=build /src/LICENSE-MIT /src/LICENSE-APACHE /usr/share/doc/dipir/
WORKDIR /work
ENTRYPOINT ["dipir"]
