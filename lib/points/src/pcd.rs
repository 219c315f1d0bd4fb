//! PCD files of the Point Cloud Library, ASCII and binary.
use glam::{DQuat, DVec3};

use crate::cloud::{Cloud, Collector};
use crate::error::{PointsError, shown};

const FORMAT: &str = "PCD";
/// Longer headers are none.
const MOST_HEADER: usize = 1 << 16;
/// Most bytes of one point.
const MOST_STRIDE: usize = 1 << 16;

fn wrong(detail: impl Into<String>) -> PointsError {
    PointsError::new(FORMAT, detail)
}

#[derive(Default)]
struct Header {
    fields: Vec<String>,
    sizes: Vec<usize>,
    kinds: Vec<String>,
    counts: Vec<usize>,
    /// Width and height of the grid of points.
    grid: [usize; 2],
    /// Product of the two, where it is not stated.
    points: Option<usize>,
    viewpoint: Vec<f64>,
    data: String,
}

/// Reads `x`, `y` and `z` of all points, moved to where the header's viewpoint says.
pub(crate) fn read(bytes: &[u8]) -> Result<Cloud, PointsError> {
    let (header, body) = header(bytes)?;
    let axes = ["x", "y", "z"].map(|name| header.fields.iter().position(|f| f == name));
    let [Some(x), Some(y), Some(z)] = axes else {
        return Err(wrong("its points have no x, y and z"));
    };
    let points = match header.data.as_str() {
        "ascii" => ascii(&header, [x, y, z], &String::from_utf8_lossy(body))?,
        "binary" => binary(&header, [x, y, z], body)?,
        other => {
            return Err(PointsError::with_remedy(
                FORMAT,
                format!("its data are \"{}\"; accepted: ascii, binary", shown(other)),
                "convert it with pcl_convert_pcd_ascii_binary in.pcd out.pcd 1",
            ));
        }
    };
    let cloud = Cloud {
        points,
        viewpoint: Some(DVec3::ZERO),
    };
    if header.viewpoint.is_empty() {
        return Ok(cloud);
    }
    let no_pose = || wrong("its viewpoint is no rotation and position");
    let [tx, ty, tz, qw, qx, qy, qz] = header.viewpoint[..] else {
        return Err(no_pose());
    };
    let (q, t) = (DQuat::from_xyzw(qx, qy, qz, qw), DVec3::new(tx, ty, tz));
    let turns = (q.length() - 1.0).abs() < 1e-3 && t.is_finite();
    if !turns {
        return Err(no_pose());
    }
    Ok(cloud.moved(1.0, glam::DMat3::from_quat(q.normalize()), t))
}

fn header(bytes: &[u8]) -> Result<(Header, &[u8]), PointsError> {
    let mut header = Header::default();
    let mut at = 0;
    while at < bytes.len().min(MOST_HEADER) {
        let end = bytes[at..].iter().position(|&b| b == b'\n');
        let end = end.map_or(bytes.len(), |n| at + n);
        let line = String::from_utf8_lossy(&bytes[at..end]).into_owned();
        at = (end + 1).min(bytes.len());
        let bad = || wrong(format!("its header says \"{}\"", shown(&line)));
        let (key, values) = line
            .trim()
            .split_once(char::is_whitespace)
            .unwrap_or((line.trim(), ""));
        let words = || values.split_whitespace();
        let numbers = || -> Result<Vec<usize>, PointsError> {
            words().map(|w| w.parse().map_err(|_| bad())).collect()
        };
        match key {
            "FIELDS" => header.fields = words().map(Into::into).collect(),
            "SIZE" => header.sizes = numbers()?,
            "TYPE" => header.kinds = words().map(Into::into).collect(),
            "COUNT" => header.counts = numbers()?,
            "WIDTH" => header.grid[0] = values.trim().parse().map_err(|_| bad())?,
            "HEIGHT" => header.grid[1] = values.trim().parse().map_err(|_| bad())?,
            "POINTS" => header.points = Some(values.trim().parse().map_err(|_| bad())?),
            "VIEWPOINT" => {
                let values = words().map(|w| w.parse::<f64>().map_err(|_| bad()));
                header.viewpoint = values.collect::<Result<_, _>>()?;
            }
            "DATA" => {
                header.data = values.trim().into();
                return header.checked().map(|h| (h, &bytes[at..]));
            }
            _ => {}
        }
    }
    Err(wrong("its header has no DATA"))
}

impl Header {
    fn points(&self) -> usize {
        let [width, height] = self.grid;
        self.points.unwrap_or(width.saturating_mul(height))
    }

    fn checked(mut self) -> Result<Self, PointsError> {
        let n = self.fields.len();
        if self.counts.is_empty() {
            self.counts = vec![1; n];
        }
        let whole = [self.sizes.len(), self.kinds.len(), self.counts.len()];
        let small = |v: &Vec<usize>| v.iter().all(|&v| v <= MOST_STRIDE);
        if whole != [n; 3] || !small(&self.sizes) || !small(&self.counts) {
            return Err(wrong("FIELDS, SIZE, TYPE and COUNT do not belong together"));
        }
        Ok(self)
    }
}

fn ascii(header: &Header, axes: [usize; 3], body: &str) -> Result<Vec<DVec3>, PointsError> {
    let column = |field: usize| header.counts[..field].iter().sum::<usize>();
    let columns = axes.map(column);
    let count = header.points();
    let mut found = Collector::new(count);
    let mut lines = body.lines().filter(|l| !l.trim().is_empty());
    for i in 0..count {
        let line = lines.next().ok_or_else(|| wrong("it is cut short"))?;
        let words: Vec<&str> = line.split_whitespace().collect();
        let at = |k: usize| words.get(columns[k]).and_then(|w| w.parse().ok());
        let (Some(x), Some(y), Some(z)) = (at(0), at(1), at(2)) else {
            return Err(wrong(format!("point {i} cannot be read")));
        };
        found.add(DVec3::new(x, y, z));
    }
    Ok(found.points())
}

fn binary(header: &Header, axes: [usize; 3], body: &[u8]) -> Result<Vec<DVec3>, PointsError> {
    let bytes = |field: usize| header.sizes[field] * header.counts[field];
    let offset = |field: usize| (0..field).map(bytes).sum::<usize>();
    let stride = offset(header.fields.len());
    for field in axes {
        if header.counts[field] == 0
            || header.kinds[field] != "F"
            || ![4, 8].contains(&header.sizes[field])
        {
            return Err(wrong("its coordinates are no numbers of 4 or 8 bytes"));
        }
    }
    let count = header.points();
    if stride > MOST_STRIDE || body.len() / stride.max(1) < count {
        return Err(wrong("it is cut short"));
    }
    let places = axes.map(|field| (offset(field), header.sizes[field]));
    let mut found = Collector::new(count);
    for point in body.chunks_exact(stride).take(count) {
        let at = |(offset, size): (usize, usize)| {
            let bytes = &point[offset..offset + size];
            match bytes.first_chunk::<8>() {
                Some(wide) => f64::from_le_bytes(*wide),
                None => bytes
                    .first_chunk()
                    .map_or(0.0, |b| f64::from(f32::from_le_bytes(*b))),
            }
        };
        found.add(DVec3::from_array(places.map(at)));
    }
    Ok(found.points())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_lines_are_cut_in_messages() {
        let long = "9".repeat(1 << 20);
        let fields = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n";
        let cut = &long[..60 - "POINTS ".len()];
        for (line, said) in [
            (
                format!("POINTS {long}\n"),
                format!("its header says \"POINTS {cut}\""),
            ),
            (
                format!("DATA {long}\n"),
                format!("its data are \"{}\"; accepted", &long[..60]),
            ),
        ] {
            let error = read(format!("{fields}{line}").as_bytes()).unwrap_err();
            assert!(error.to_string().contains(&said));
        }
    }
}
