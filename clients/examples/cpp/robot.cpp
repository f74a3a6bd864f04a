// A robot and a planner in one: puts a cloud of a made-up room, waits for its receipt, and asks three points.
//   robot [tcp/127.0.0.1:7447] [MAP]
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <mutex>
#include <random>

#include <zenoh.hxx>

#include "messages.hpp"

namespace {

constexpr auto kWait = std::chrono::seconds(60);  // a server that has just started compiles its numerics first
const std::string kRobot = "cpp-1";

zenoh::Encoding encoding_of(const char* schema) {
    zenoh::Encoding encoding("application/msgpack");
    encoding.set_schema(schema);
    return encoding;
}

zenoh::Session connected(const std::string& endpoint) {
    auto config = zenoh::Config::create_default();
#ifdef ZENOHCXX_ZENOHC
    config.insert_json5("mode", "\"client\"");
    config.insert_json5("connect/endpoints", "[\"" + endpoint + "\"]");
#else
    config.insert(Z_CONFIG_MODE_KEY, "client");
    config.insert(Z_CONFIG_CONNECT_KEY, endpoint.c_str());
#endif
    return zenoh::Session::open(std::move(config));
}

// The walls of a room of 8 by 6 m, seen from its middle.
pot::Cloud scan(int64_t seq, const std::string& session) {
    std::mt19937 random(7);
    std::uniform_real_distribution<float> along(-1.0F, 1.0F);
    std::vector<float> points;
    for (int i = 0; i < 4000; ++i) {
        const float a = along(random), height = along(random), side = i % 2 ? 1.0F : -1.0F;
        const bool is_long_wall = i % 4 < 2;
        points.insert(points.end(), {is_long_wall ? 4.0F * a : 4.0F * side, is_long_wall ? 3.0F * side : 3.0F * a, height});
    }
    const std::vector<double> pose{1, 0, 0, 10, 0, 1, 0, 0, 0, 0, 1, 1.5, 0, 0, 0, 1};  // p_map = pose @ p_sensor
    const auto now = std::chrono::system_clock::now().time_since_epoch();
    pot::Cloud cloud;
    cloud.seq = seq;
    cloud.stamp_ns = std::chrono::duration_cast<std::chrono::nanoseconds>(now).count();
    cloud.points = pot::Array::of("<f4", {static_cast<int64_t>(points.size() / 3), 3}, points);
    cloud.T_map_sensor = pot::Array::of("<f8", {4, 4}, pose);
    cloud.session = session;
    return cloud;
}

// Puts a cloud and waits for its receipt: a PUT cannot fail, only its receipt says what became of it.
pot::Receipt published(zenoh::Session& session, const std::string& root, const pot::Cloud& cloud) {
    std::mutex mutex;
    std::condition_variable came;
    std::optional<pot::Receipt> receipt;
    const auto subscriber = session.declare_subscriber(
        zenoh::KeyExpr(root + "/out/" + kRobot + "/receipt"),
        [&](const zenoh::Sample& sample) {
            const auto found = pot::read_receipt(sample.get_payload().as_vector());
            const std::lock_guard lock(mutex);
            if (found.seq == cloud.seq) receipt = found;
            came.notify_all();
        },
        zenoh::closures::none);
    zenoh::Session::PutOptions options;
    options.encoding = encoding_of("pot.cloud.v1");
    options.congestion_control = zenoh::CongestionControl::Z_CONGESTION_CONTROL_BLOCK;
    session.put(zenoh::KeyExpr(root + "/in/" + kRobot + "/cloud"), pot::written(cloud), std::move(options));
    std::unique_lock lock(mutex);
    if (!came.wait_for(lock, kWait, [&] { return receipt.has_value(); })) throw std::runtime_error("no receipt came");
    return *receipt;
}

// A question without any reply is an error: no server, no such map, or access was denied.
pot::Occupancy asked(zenoh::Session& session, const std::string& root, const pot::PointsQuery& query) {
    std::mutex mutex;
    std::condition_variable came;
    std::optional<pot::Occupancy> answer;
    std::string trouble = "no answer came: no server, no such map, or access was denied";
    bool done = false;
    zenoh::Session::GetOptions options;
    options.payload = zenoh::Bytes(pot::written(query));
    options.encoding = encoding_of("pot.points_query.v1");
    options.timeout_ms = std::chrono::milliseconds(kWait).count();
    session.get(
        zenoh::KeyExpr(root + "/q/points"), "",
        [&](const zenoh::Reply& reply) {
            const std::lock_guard lock(mutex);
            if (reply.is_ok()) {
                answer = pot::read_occupancy(reply.get_ok().get_payload().as_vector());
            } else {
                const auto error = pot::read_error(reply.get_err().get_payload().as_vector());
                trouble = error.code + ": " + error.message;
            }
        },
        [&] {
            const std::lock_guard lock(mutex);
            done = true;
            came.notify_all();
        },
        std::move(options));
    std::unique_lock lock(mutex);
    came.wait(lock, [&] { return done; });
    if (!answer) throw std::runtime_error(trouble);
    return *answer;
}

}  // namespace

int main(int argc, char** argv) {
    try {
        auto session = connected(argc > 1 ? argv[1] : "tcp/127.0.0.1:7447");
        const std::string root = std::string("pot/v1/") + (argc > 2 ? argv[2] : "default");
        const auto started = std::chrono::system_clock::now().time_since_epoch().count();
        const auto receipt = published(session, root, scan(0, "cpp-" + std::to_string(started)));
        std::printf("cloud %lld: %s %s revision %lld\n", static_cast<long long>(receipt.seq), receipt.status.c_str(),
                    receipt.reason.value_or("").c_str(), static_cast<long long>(receipt.map_revision));
        if (receipt.status != "accepted") return 1;

        const std::vector<double> points{10, 0, 1.5, 14, 0, 1.5, 10, 0, 40};  // free, in a wall, never seen
        pot::PointsQuery query;
        query.points = pot::Array::of("<f8", {3, 3}, points);
        const auto answer = asked(session, root, query);
        const auto mean = answer.mean.values<float>(), var = answer.var.values<float>();
        for (size_t i = 0; i < mean.size(); ++i) {
            std::printf("%.1f %.1f %.1f: P(occupied) %.4f, sd %.4f, %s\n", points[3 * i], points[3 * i + 1], points[3 * i + 2],
                        mean[i], std::sqrt(var[i]), answer.observed.data[i] ? "observed" : "unknown");
        }
        return 0;
    } catch (const std::exception& error) {  // zenoh::ZException is one
        std::fprintf(stderr, "robot: %s\n", error.what());
        return 1;
    }
}
