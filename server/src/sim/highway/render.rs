//! Pictures of the highway (the paper's Fig. 3): the road round the host, drawn to scale along it, and the whole window small.
//!
//! Traffic drives to the right; the fast lane is on top, as the driver sees it on the left.

use std::fmt::Write as _;

use super::{
    Highway,
    road::{FRONT_M, LANES, LENGTH_M, LOOK_AHEAD_M, REAR_M},
};

/// Metres of one character.
const CHARACTER_M: f64 = 5.0;
/// Metres shown behind and ahead of the host.
const BEHIND_M: f64 = 45.0;
const AHEAD_M: f64 = 125.0;
/// Pixels of a metre along the road. Across the road everything is drawn wider, for people to see it.
const SCALE: f64 = 7.0;
const LANE_PX: f64 = 56.0;
const CAR_WIDTH_PX: f64 = 18.0;
/// How far below the middle of its lane a car is drawn.
const LABEL_PX: f64 = 6.0;
/// Verge above and below the lanes.
const VERGE_PX: f64 = 26.0;
/// Strip for the caption and the overview.
const CAPTION_PX: f64 = 86.0;
const WIDTH_PX: f64 = (BEHIND_M + AHEAD_M) * SCALE;
const ROAD_PX: f64 = 2.0 * VERGE_PX + LANES as f64 * LANE_PX;
/// Colour of each lane's traffic, from the slow to the fast one.
const LANE_COLOURS: [&str; LANES] = ["#7fb2e5", "#7fd1a6", "#f2cf63"];
const HOST_COLOUR: &str = "#ff4d3d";
/// Name and colour of each traffic state.
const TRAFFIC: [(&str, &str); 3] = [("clear", "#52d681"), ("passable", "#f5b942"), ("boxed in", "#ef5b5b")];

/// Three lanes of `o` (a vehicle) and `@` (the host), a character for each 5 m, and a line about the host.
pub(super) fn text(highway: &Highway) -> String {
    let road = &highway.road;
    let columns = ((FRONT_M - REAR_M) / CHARACTER_M) as usize;
    let mut text = String::new();
    for lane in (0..LANES).rev() {
        let mut row = vec![b'.'; columns];
        let mut mark = |x_m: f64, mark: u8| {
            let column = ((x_m - REAR_M) / CHARACTER_M).floor();
            if column >= 0.0 && column < columns as f64 {
                row[column as usize] = mark;
            }
        };
        road.vehicles().filter(|vehicle| vehicle.lane == lane).for_each(|vehicle| mark(vehicle.x_m, b'o'));
        if lane == road.host_lane {
            mark(0.0, b'@');
        }
        let _ = writeln!(text, "lane {lane} |{}|", String::from_utf8_lossy(&row));
    }
    let _ = writeln!(text, "{}", caption(highway));
    text
}

/// Where the host is, how fast, among what, and what happened.
fn caption(highway: &Highway) -> String {
    let (road, events) = (&highway.road, highway.events);
    let lane = ["right", "middle", "left"][road.host_lane];
    let gap_m = road.view().ahead_m[road.host_lane];
    let gap = if gap_m < FRONT_M { format!("{gap_m:.0} m to the vehicle ahead") } else { "open road".to_owned() };
    let mut caption = format!("{} m/s, {lane} lane, {}, {gap}", road.host_speed_mps(), TRAFFIC[highway.traffic()].0);
    for (count, what) in [
        (events.collisions, "collision"),
        (events.overtakes_left, "overtaken from the left"),
        (events.overtakes_right, "overtaken from the right"),
    ] {
        if count > 0 {
            let _ = write!(caption, ", {count} {what}");
        }
    }
    caption
}

/// Left edge of the picture is [`BEHIND_M`] behind the host.
fn x_px(x_m: f64) -> f64 {
    (x_m + BEHIND_M) * SCALE
}

/// Middle of the cars of a lane, below its own to leave room for a label.
fn lane_px(lane: usize) -> f64 {
    VERGE_PX + ((LANES - 1 - lane) as f64 + 0.5) * LANE_PX + LABEL_PX
}

/// An SVG document of 1190 × 306 pixels.
pub(super) fn svg(highway: &Highway) -> String {
    let height = ROAD_PX + CAPTION_PX;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH_PX}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH_PX} {height}\" font-family=\"Ubuntu, sans-serif\">\n"
    );
    draw_road(&mut svg, highway.road.driven_m);
    draw_look_ahead(&mut svg, highway);
    for vehicle in highway.road.vehicles().filter(|v| v.x_m > -BEHIND_M - LENGTH_M && v.x_m < AHEAD_M + LENGTH_M) {
        draw_car(
            &mut svg,
            x_px(vehicle.x_m),
            lane_px(vehicle.lane),
            LANE_COLOURS[vehicle.lane],
            vehicle.speed_mps,
            false,
        );
    }
    let road = &highway.road;
    draw_car(&mut svg, x_px(0.0), lane_px(road.host_lane), HOST_COLOUR, road.host_speed_mps(), true);
    draw_caption(&mut svg, highway);
    svg.push_str("</svg>\n");
    svg
}

fn rect(svg: &mut String, [x, y, width, height]: [f64; 4], attributes: &str) {
    let _ = writeln!(svg, r#"<rect x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}" {attributes}/>"#);
}

fn text_at(svg: &mut String, [x, y, size]: [f64; 3], anchor: &str, fill: &str, text: &str) {
    // The embedded typeface is a light one: a hairline of the same colour makes it legible on asphalt.
    let _ = writeln!(
        svg,
        r#"<text x="{x:.1}" y="{y:.1}" font-size="{size}" text-anchor="{anchor}" fill="{fill}" stroke="{fill}" stroke-width="0.4">{text}</text>"#
    );
}

fn draw_road(svg: &mut String, driven_m: f64) {
    rect(svg, [0.0, 0.0, WIDTH_PX, ROAD_PX], r##"fill="#3f6b45""##);
    let asphalt = LANES as f64 * LANE_PX;
    rect(svg, [0.0, VERGE_PX - 8.0, WIDTH_PX, asphalt + 16.0], r##"fill="#43474f""##);
    for y in [VERGE_PX, VERGE_PX + asphalt] {
        rect(svg, [0.0, y - 1.5, WIDTH_PX, 3.0], r##"fill="#f4f4f4""##);
    }
    // German motorway: dashes of 6 m every 18 m. Delineator posts every 50 m.
    for lane in 1..LANES {
        let y = VERGE_PX + lane as f64 * LANE_PX;
        let offset = (driven_m % 18.0) * SCALE;
        let _ = writeln!(
            svg,
            r##"<line x1="0" y1="{y}" x2="{WIDTH_PX}" y2="{y}" stroke="#f4f4f4" stroke-width="2.5" stroke-dasharray="{} {}" stroke-dashoffset="{offset:.1}"/>"##,
            6.0 * SCALE,
            12.0 * SCALE
        );
    }
    let mut post_m = -(driven_m % 50.0) - BEHIND_M.div_euclid(50.0) * 50.0 - 50.0;
    while post_m < AHEAD_M {
        for y in [VERGE_PX - 20.0, VERGE_PX + asphalt + 12.0] {
            rect(svg, [x_px(post_m) - 2.0, y, 4.0, 8.0], r##"fill="#f4f4f4" rx="1""##);
        }
        post_m += 50.0;
    }
    for lane in 0..LANES {
        let name = ["right lane", "middle lane", "left lane"][lane];
        text_at(svg, [8.0, lane_px(lane) - LABEL_PX + LANE_PX / 2.0 - 7.0, 11.0], "start", "#aeb4bf", name);
    }
}

/// The look-ahead in the colour of the traffic state.
fn draw_look_ahead(svg: &mut String, highway: &Highway) {
    let (name, colour) = TRAFFIC[highway.traffic()];
    let (y, start) = (lane_px(highway.road.host_lane), x_px(LENGTH_M / 2.0));
    let end = x_px(LOOK_AHEAD_M - LENGTH_M / 2.0);
    let (top, height) = (y - LABEL_PX - LANE_PX / 2.0 + 3.0, LANE_PX - 6.0);
    rect(svg, [start, top, end - start, height], &format!(r#"fill="{colour}" fill-opacity="0.22""#));
    rect(svg, [end - 2.0, top, 2.0, height], &format!(r#"fill="{colour}""#));
    text_at(svg, [start + 12.0, top + height - 4.0, 12.0], "start", colour, &format!("{name}, {LOOK_AHEAD_M} m"));
}

/// A car from above, driving to the right, its speed written over it.
fn draw_car(svg: &mut String, x: f64, y: f64, colour: &str, speed_mps: f64, host: bool) {
    let (length, width) = (LENGTH_M * SCALE, CAR_WIDTH_PX);
    let (left, top) = (x - length / 2.0, y - width / 2.0);
    if host {
        let ring = [left - 5.0, top - 5.0, length + 10.0, width + 10.0];
        rect(svg, ring, r##"rx="10" fill="#ffffff" fill-opacity="0.18" stroke="#ffffff" stroke-width="2""##);
    }
    for (wheel_x, wheel_y) in [(0.14, -2.0), (0.68, -2.0), (0.14, width - 2.0), (0.68, width - 2.0)] {
        rect(svg, [left + wheel_x * length, top + wheel_y, 7.0, 4.0], r##"rx="1.5" fill="#15171a""##);
    }
    let outline = if host { "#7d1208" } else { "#23262b" };
    let body = format!(r#"rx="6" fill="{colour}" stroke="{outline}" stroke-width="1""#);
    rect(svg, [left, top, length, width], &body);
    // Windscreen, rear window and the roof between them.
    let [rear, roof_start, roof_end, front] = [0.16, 0.27, 0.56, 0.70].map(|part| left + part * length);
    let (inner_top, inner_bottom) = (top + 3.0, top + width - 3.0);
    let _ = writeln!(
        svg,
        r##"<path d="M{front:.1} {:.1}L{front:.1} {:.1}L{roof_end:.1} {inner_bottom:.1}L{roof_end:.1} {inner_top:.1}ZM{rear:.1} {:.1}L{rear:.1} {:.1}L{roof_start:.1} {inner_bottom:.1}L{roof_start:.1} {inner_top:.1}Z" fill="#1d2733"/>"##,
        inner_top - 1.0,
        inner_bottom + 1.0,
        inner_top + 0.5,
        inner_bottom - 0.5,
    );
    for light in [top + 2.0, top + width - 5.0] {
        rect(svg, [left + length - 2.5, light, 3.0, 3.0], r##"rx="1" fill="#fff6c2""##);
        rect(svg, [left - 0.5, light, 2.5, 3.0], r##"rx="1" fill="#c81e1e""##);
    }
    let (size, fill) = if host { (14.0, "#ffffff") } else { (12.0, "#e8eaee") };
    let label = if host { format!("{speed_mps:.0} m/s") } else { format!("{speed_mps:.0}") };
    let lift = if host { 9.0 } else { 4.0 };
    text_at(svg, [x, top - lift, size], "middle", fill, &label);
}

/// What the host does, and the whole window small.
fn draw_caption(svg: &mut String, highway: &Highway) {
    let top = ROAD_PX;
    rect(svg, [0.0, top, WIDTH_PX, CAPTION_PX], r##"fill="#1d2026""##);
    rect(svg, [16.0, top + 14.0, 18.0, 11.0], &format!(r#"rx="3" fill="{HOST_COLOUR}""#));
    text_at(svg, [42.0, top + 25.0, 16.0], "start", "#ffffff", &caption(highway));
    let mut legend_x = WIDTH_PX - 16.0;
    for (lane, speed) in super::road::LANE_SPEED_MPS.iter().enumerate().rev() {
        text_at(svg, [legend_x, top + 24.0, 12.0], "end", "#c3c8d1", &format!("about {speed} m/s"));
        rect(svg, [legend_x - 102.0, top + 15.0, 14.0, 9.0], &format!(r#"rx="2" fill="{}""#, LANE_COLOURS[lane]));
        legend_x -= 122.0;
    }
    // The overview, 3.3 pixels a metre.
    let (left, width) = (16.0, WIDTH_PX - 32.0);
    let place = |x_m: f64| left + (x_m - REAR_M) / (FRONT_M - REAR_M) * width;
    let (map_top, map_lane) = (top + 38.0, 10.0);
    rect(svg, [left, map_top, width, 3.0 * map_lane], r##"rx="3" fill="#3a3e46""##);
    let shown = [place(-BEHIND_M), map_top, place(AHEAD_M) - place(-BEHIND_M), 3.0 * map_lane];
    rect(svg, shown, r##"fill="#ffffff" fill-opacity="0.08""##);
    let mut dot = |x_m: f64, lane: usize, colour: &str| {
        if (REAR_M + LENGTH_M..=FRONT_M - LENGTH_M).contains(&x_m) {
            let y = map_top + (LANES - 1 - lane) as f64 * map_lane + 2.5;
            rect(svg, [place(x_m) - 8.0, y, 16.0, 5.0], &format!(r#"rx="2" fill="{colour}""#));
        }
    };
    highway.road.vehicles().for_each(|vehicle| dot(vehicle.x_m, vehicle.lane, LANE_COLOURS[vehicle.lane]));
    dot(0.0, highway.road.host_lane, HOST_COLOUR);
    for (x_m, anchor) in [(REAR_M, "start"), (0.0, "middle"), (100.0, "middle"), (200.0, "middle"), (FRONT_M, "end")] {
        text_at(svg, [place(x_m), top + 81.0, 10.0], anchor, "#8d94a1", &format!("{x_m} m"));
    }
}
