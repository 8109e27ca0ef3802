// Extended position-based dynamics of cloth (Macklin et al. 2016) with small steps (Macklin et al. 2019): one correction a
// substep of edges, hinges, springs, tethers and contacts, in the order of their arrays (Gauss-Seidel), on one thread.
//
// Small cloth in float: about 800 particles a garment, a thousand substeps a second. Nothing here depends on the time of
// day, on threads or, being built without contraction, on the CPU: the same bits everywhere.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "cloth/vec3.hpp"
#include "common/status.hpp"

namespace {

using smplxpp::Vec3;

// What a garment is, over n particles, m faces, e edges, b hinges and a collider of c vertices and d faces.
// smplxpp/cloth/solver.py says the same.
struct Model {
    int64_t particles, faces, edges, hinges, collider_vertices, collider_faces;
    const float* inverse_mass;         // n: 1/kg, 0: follows its place exactly
    const int32_t* face;               // 3 m
    const int32_t* edge;               // 2 e
    const float* length;               // e: metres at rest
    const float* stretch;              // e: m/N where it is longer
    const float* compress;             // e: m/N where it is shorter
    const int32_t* hinge;              // 4 b: the edge's ends, then the corners across
    const float* curvature;            // 4 b: weights of the corners in the curvature vector
    const float* rest_curvature;       // b: along the hinge's normal
    const float* bend;                 // b: compliance
    const float* spring;               // n: m/N of the spring to its place, inf: none; null: nobody has one
    const int32_t* anchor;             // n: particle of the tether, -1: none
    const float* tether;               // n: metres at most
    const int32_t* collider_face;      // 3 d
    const float* margin;               // c: metres that cloth keeps from it
    const float* deepest;              // c: metres; deeper cloth is on the other side
};

struct Forces {
    double gravity, drag, normal_drag, inner_friction, friction, own_margin, most_speed;
};

// Four moments of the places and of the collider: the last one, this one's start and end, the next one.
struct Moments {
    const float *place[4], *collider[4];
};

// Catmull and Rom's curve through the moments; t in [0, 1] from the second to the third.
void at_time(const float* const* moments, int64_t count, float t, Vec3* out) {
    const float t2 = t * t, t3 = t2 * t;
    const float a = -0.5f * t3 + t2 - 0.5f * t, b = 1.5f * t3 - 2.5f * t2 + 1.0f;
    const float c = -1.5f * t3 + 2.0f * t2 + 0.5f * t, d = 0.5f * t3 - 0.5f * t2;
    for (int64_t i = 0; i < 3 * count; ++i)
        (&out->x)[i] = a * moments[0][i] + b * moments[1][i] + c * moments[2][i] + d * moments[3][i];
}

// Points by the cell of a grid that they lie in.
class Grid {
public:
    void fill(const Vec3* points, int64_t count, float cell) {
        over_ = 1.0f / cell;
        head_.assign(kCells, -1);
        next_.resize(size_t(count));
        for (int32_t i = 0; i < count; ++i) {
            const uint32_t at = key(of(points[i].x), of(points[i].y), of(points[i].z));
            next_[size_t(i)] = head_[at];
            head_[at] = i;
        }
    }
    // Calls visit with the points of the 27 cells about one.
    template <class Visit>
    void around(Vec3 p, Visit&& visit) const {
        const int32_t x = of(p.x), y = of(p.y), z = of(p.z);
        for (int32_t i = x - 1; i <= x + 1; ++i)
            for (int32_t j = y - 1; j <= y + 1; ++j)
                for (int32_t k = z - 1; k <= z + 1; ++k)
                    for (int32_t q = head_[key(i, j, k)]; q >= 0; q = next_[size_t(q)]) visit(q);
    }

private:
    static constexpr uint32_t kCells = 1u << 14;
    static uint32_t key(int32_t i, int32_t j, int32_t k) {
        return (uint32_t(i) * 73856093u ^ uint32_t(j) * 19349663u ^ uint32_t(k) * 83492791u) & (kCells - 1);
    }
    int32_t of(float x) const {  // far and broken points share a cell: a cast of them has no value
        const float cell = std::floor(x * over_);
        return cell > -1e9f && cell < 1e9f ? int32_t(cell) : 0;
    }
    float over_ = 1.0f;
    std::vector<int32_t> head_, next_;
};

struct Contact {
    int32_t face;  // of the collider, -1: none
    float weight[3];
};

void add_normals(const Vec3* x, const int32_t* face, int64_t count, Vec3* out) {
    for (int64_t k = 0; k < count; ++k) {
        const int32_t* q = face + 3 * k;
        const Vec3 n = cross(x[q[1]] - x[q[0]], x[q[2]] - x[q[0]]);
        for (int j = 0; j < 3; ++j) out[q[j]] = out[q[j]] + n;
    }
}

void normals(const Vec3* x, const int32_t* face, int64_t faces, std::vector<Vec3>& out) {
    std::fill(out.begin(), out.end(), Vec3{0, 0, 0});
    add_normals(x, face, faces, out.data());
    for (Vec3& n : out) n = n * (1.0f / std::max(length(n), 1e-12f));
}

// A moving surface that cloth may touch: where a point's nearest vertex is, and the nearest place on its faces
// and on those about.
class Surface {
public:
    Surface(int64_t vertices, const int32_t* face, int64_t faces)
        : face_(face), faces_(faces), normal_(size_t(vertices)), first_(size_t(vertices) + 1, 0), at_(3 * size_t(faces)) {
        for (size_t i = 0; i < at_.size(); ++i) ++first_[size_t(face[i]) + 1];
        for (size_t i = 0; i + 1 < first_.size(); ++i) first_[i + 1] += first_[i];
        std::vector<int32_t> next(first_.begin(), first_.end() - 1);
        for (size_t i = 0; i < at_.size(); ++i) at_[size_t(next[size_t(face[i])]++)] = int32_t(i / 3);
    }
    // Take the vertices as they are now; find() looks among these.
    void look(const Vec3* vertex) {
        vertex_ = vertex;
        normals(vertex, face_, faces_, normal_);
        grid_.fill(vertex, int64_t(normal_.size()), kReach);
    }
    Vec3 normal(int32_t i) const { return normal_[size_t(i)]; }

    Contact find(Vec3 p, Vec3 cloth_normal) const {
        Contact found = {-1, {0, 0, 0}};
        int32_t near = -1;
        float best = kReach * kReach;
        grid_.around(p, [&](int32_t j) {
            const Vec3 d = p - vertex_[j];
            const float squared = dot(d, d);
            // Skin that faces the cloth's outer side, an arm that lies on a flank, makes no contact.
            if (squared < best && dot(normal_[size_t(j)], cloth_normal) > kCovers) best = squared, near = j;
        });
        if (near < 0) return found;
        best = 1e9f;
        // Among large and small triangles the nearest face need not be one of the nearest vertex: where the place lies on
        // the far side of the vertex's faces, look on from there.
        for (int step = 0; step < kSteps && scan(p, near, best, found); ++step) {
            const int32_t* q = face_ + 3 * int64_t(found.face);
            int32_t next = near;
            float most = 0;
            for (int j = 0; j < 3; ++j) {
                if (q[j] == near && found.weight[j] > 0) return found;
                if (found.weight[j] > most) most = found.weight[j], next = q[j];
            }
            if (!(dot(normal_[size_t(next)], cloth_normal) > kCovers)) break;
            near = next;
        }
        return found;
    }

private:
    // Looks for a place nearer than the best on the faces of a vertex; says whether there is one.
    bool scan(Vec3 p, int32_t vertex, float& best, Contact& found) const {
        bool nearer = false;
        for (int32_t k = first_[size_t(vertex)]; k < first_[size_t(vertex) + 1]; ++k) {
            const int32_t* q = face_ + 3 * int64_t(at_[size_t(k)]);
            float weight[3];
            const Vec3 d = p - smplxpp::closest_on_triangle(p, vertex_[q[0]], vertex_[q[1]], vertex_[q[2]], weight);
            if (!(dot(d, d) < best)) continue;  // nor a triangle without area
            best = dot(d, d), nearer = true;
            found.face = at_[size_t(k)];
            std::copy(weight, weight + 3, found.weight);
        }
        return nearer;
    }

    static constexpr int kSteps = 8;          // from one vertex's faces to the next one's
    static constexpr float kReach = 0.035f;   // metres within which a vertex is found
    static constexpr float kCovers = -0.3f;   // least cosine between skin's and cloth's normals
    const int32_t* face_;
    int64_t faces_;
    const Vec3* vertex_ = nullptr;
    std::vector<Vec3> normal_;
    std::vector<int32_t> first_, at_;
    Grid grid_;
};

class Solver {
public:
    Solver(const Model& m, const Forces& f, Vec3* position, Vec3* velocity)
        : m_(m), f_(f), x_(position), v_(velocity), n_(size_t(m.particles)), before_(n_), place_(n_), normal_(n_),
          skin_(size_t(m.collider_vertices)), skin_before_(skin_.size()),
          surface_(m.collider_vertices, m.collider_face, m.collider_faces), contact_(n_, Contact{-1, {0, 0, 0}}) {}

    void advance(const Moments& moments, float seconds, int32_t substeps, int32_t contacts_every) {
        const float h = seconds / float(substeps);
        at_time(moments.collider, m_.collider_vertices, 0.0f, skin_.data());
        for (int32_t s = 0; s < substeps; ++s) {
            const float t = float(s + 1) / float(substeps);
            skin_before_.swap(skin_);
            at_time(moments.place, m_.particles, t, place_.data());
            at_time(moments.collider, m_.collider_vertices, t, skin_.data());
            const bool looks = s % contacts_every == 0;
            if (looks || f_.normal_drag > 0) normals(x_, m_.face, m_.faces, normal_);
            move(h);
            if (looks) find_contacts();
            if (looks && f_.own_margin > 0) find_pairs();
            stretch(h);
            bend(h);
            if (m_.spring) pull(h);
            hold();
            if (f_.own_margin > 0) part();
            touch();
            finish(h);
        }
    }

private:
    float w(int64_t i) const { return m_.inverse_mass[i]; }

    // Gravity and air, then on by the velocity.
    void move(float h) {
        const float drag = 1.0f / (1.0f + float(f_.drag) * h), fall = float(f_.gravity) * h;
        const float across = 1.0f - 1.0f / (1.0f + float(f_.normal_drag) * h);
        for (size_t i = 0; i < n_; ++i) {
            before_[i] = x_[i];
            if (w(int64_t(i)) == 0) {
                x_[i] = place_[i];
                continue;
            }
            Vec3 v = v_[i];
            if (across > 0) v = v - normal_[i] * (dot(v, normal_[i]) * across);
            v.y -= fall;
            x_[i] = x_[i] + v * (drag * h);
        }
    }

    void stretch(float h) {
        const float over = 1.0f / (h * h);
        for (int64_t k = 0; k < m_.edges; ++k) {
            const int32_t i = m_.edge[2 * k], j = m_.edge[2 * k + 1];
            const Vec3 d = x_[i] - x_[j];
            const float l = length(d), error = l - m_.length[k];
            const float soft = (error < 0 ? m_.compress : m_.stretch)[k] * over;
            const Vec3 step = d * (error / (std::max(l, 1e-9f) * std::max(w(i) + w(j) + soft, 1e-20f)));
            x_[i] = x_[i] - step * w(i);
            x_[j] = x_[j] + step * w(j);
        }
    }

    // The quadratic model of Bergou et al. 2006: the curvature vector's part along the hinge's normal returns to that at rest.
    void bend(float h) {
        const float over = 1.0f / (h * h);
        for (int64_t k = 0; k < m_.hinges; ++k) {
            const int32_t* q = m_.hinge + 4 * k;
            const float* c = m_.curvature + 4 * k;
            const Vec3 along = x_[q[1]] - x_[q[0]];
            const Vec3 n = cross(along, x_[q[2]] - x_[q[0]]) + cross(x_[q[3]] - x_[q[0]], along);
            const float l = length(n);
            if (!(l > 1e-12f)) continue;
            const Vec3 unit = n * (1.0f / l);
            Vec3 curvature = {0, 0, 0};
            float weight = m_.bend[k] * over;
            for (int j = 0; j < 4; ++j) {
                curvature = curvature + x_[q[j]] * c[j];
                weight += w(q[j]) * c[j] * c[j];
            }
            const Vec3 step = unit * ((dot(curvature, unit) - m_.rest_curvature[k]) / std::max(weight, 1e-20f));
            for (int j = 0; j < 4; ++j) x_[q[j]] = x_[q[j]] - step * (w(q[j]) * c[j]);
        }
    }

    void pull(float h) {
        const float over = 1.0f / (h * h);
        for (size_t i = 0; i < n_; ++i) {
            const float mass = w(int64_t(i)), soft = m_.spring[i] * over;
            if (mass > 0 && std::isfinite(soft)) x_[i] = x_[i] + (place_[i] - x_[i]) * (mass / (mass + soft));
        }
    }

    // Long-range attachments (Kim et al. 2012).
    void hold() {
        for (size_t i = 0; i < n_; ++i) {
            const int32_t to = m_.anchor[i];
            if (to < 0 || w(int64_t(i)) == 0) continue;
            const Vec3 d = x_[i] - x_[to];
            const float squared = dot(d, d), most = m_.tether[i];
            if (squared > most * most) x_[i] = x_[to] + d * (most / std::sqrt(squared));
        }
    }

    void find_contacts() {
        surface_.look(skin_.data());
        for (size_t i = 0; i < n_; ++i)
            contact_[i] = w(int64_t(i)) == 0 ? Contact{-1, {0, 0, 0}} : surface_.find(x_[i], normal_[i]);
    }

    // Out of the collider along its smooth normal; Coulomb's friction against its own motion.
    void touch() {
        const float friction = float(f_.friction);
        for (size_t i = 0; i < n_; ++i) {
            if (contact_[i].face < 0 || w(int64_t(i)) == 0) continue;
            const int32_t* q = m_.collider_face + 3 * int64_t(contact_[i].face);
            const float* b = contact_[i].weight;
            Vec3 p = {0, 0, 0}, was = {0, 0, 0}, n = {0, 0, 0};
            float margin = 0, deepest = 0;
            for (int j = 0; j < 3; ++j) {
                p = p + skin_[size_t(q[j])] * b[j];
                was = was + skin_before_[size_t(q[j])] * b[j];
                n = n + surface_.normal(q[j]) * b[j];
                margin += m_.margin[q[j]] * b[j];
                deepest += m_.deepest[q[j]] * b[j];
            }
            const float l = length(n);
            if (l < 1e-6f) continue;
            n = n * (1.0f / l);
            const float height = dot(x_[i] - p, n), depth = margin - height;
            if (depth <= 0 || height < -deepest) continue;
            x_[i] = x_[i] + n * depth;
            Vec3 slip = (x_[i] - before_[i]) - (p - was);
            slip = slip - n * dot(slip, n);
            const float way = length(slip);
            if (way > 1e-9f) x_[i] = x_[i] - slip * std::min(1.0f, friction * depth / way);
        }
    }

    // Particles that came nearer than the margin, their own neighbours aside.
    void find_pairs() {
        const float reach = 1.5f * float(f_.own_margin);
        pairs_.clear();
        own_.fill(x_, m_.particles, reach);
        for (int32_t i = 0; i < m_.particles; ++i)
            own_.around(x_[i], [&](int32_t j) {
                if (j <= i) return;
                const Vec3 d = x_[i] - x_[j];
                if (dot(d, d) < reach * reach && !neighbours(i, j)) pairs_.push_back({i, j});
            });
    }

    bool neighbours(int32_t i, int32_t j) {
        if (linked_.empty() && m_.edges) {
            for (int64_t k = 0; k < m_.edges; ++k)
                linked_.push_back(link(m_.edge[2 * k], m_.edge[2 * k + 1]));
            std::sort(linked_.begin(), linked_.end());
        }
        return std::binary_search(linked_.begin(), linked_.end(), link(i, j));
    }
    static int64_t link(int32_t i, int32_t j) { return (int64_t(std::min(i, j)) << 32) | std::max(i, j); }

    void part() {
        const float margin = float(f_.own_margin);
        for (const auto& [i, j] : pairs_) {
            const float masses = w(i) + w(j);
            const Vec3 d = x_[i] - x_[j];
            const float l = length(d);
            if (masses == 0 || l >= margin || l < 1e-7f) continue;
            const Vec3 step = d * ((margin - l) / (masses * l));
            x_[i] = x_[i] + step * w(i);
            x_[j] = x_[j] - step * w(j);
        }
    }

    // Velocities of what was moved; neighbours drag each other along.
    void finish(float h) {
        const float over = 1.0f / h, most = float(f_.most_speed);
        for (size_t i = 0; i < n_; ++i) {
            v_[i] = (x_[i] - before_[i]) * over;
            const float speed = length(v_[i]);
            if (speed > most) v_[i] = v_[i] * (most / speed);
        }
        const float share = std::min(0.45f, float(f_.inner_friction) * h);
        if (share <= 0) return;
        for (int64_t k = 0; k < m_.edges; ++k) {
            const int32_t i = m_.edge[2 * k], j = m_.edge[2 * k + 1];
            const float masses = w(i) + w(j);
            if (masses == 0) continue;
            const Vec3 d = (v_[i] - v_[j]) * (share / masses);
            v_[i] = v_[i] - d * w(i);
            v_[j] = v_[j] + d * w(j);
        }
    }

    struct Pair {
        int32_t i, j;
    };
    const Model& m_;
    const Forces& f_;
    Vec3 *x_, *v_;
    size_t n_;
    std::vector<Vec3> before_, place_, normal_, skin_, skin_before_;
    Surface surface_;
    std::vector<Contact> contact_;
    std::vector<Pair> pairs_;
    std::vector<int64_t> linked_;
    Grid own_;
};

void check(const Model& m) {
    using smplxpp::check_indices;
    check_indices(m.face, 3 * m.faces, m.particles);
    check_indices(m.edge, 2 * m.edges, m.particles);
    check_indices(m.hinge, 4 * m.hinges, m.particles);
    check_indices(m.collider_face, 3 * m.collider_faces, m.collider_vertices);
    for (int64_t i = 0; i < m.particles; ++i)
        if (m.anchor[i] < -1 || m.anchor[i] >= m.particles) throw std::out_of_range("anchor");
}

}  // namespace

// Moves n particles (3 n metres, metres a second, in place) on by `seconds`.
SMPLXPP_EXPORT int32_t smplxpp_cloth_advance(const Model* model, const Forces* forces, const Moments* moments, float seconds,
                                             int32_t substeps, int32_t contacts_every, float* position, float* velocity) {
    return smplxpp::guarded([&] {
        check(*model);
        if (substeps < 1 || contacts_every < 1) throw std::out_of_range("substeps");
        Solver(*model, *forces, (Vec3*)position, (Vec3*)velocity).advance(*moments, seconds, substeps, contacts_every);
    });
}

// Moves n points (3 n metres, in place) with outward normals to `margin` metres outside a surface of c vertices and d faces,
// where they lie less than `deepest` metres behind it.
SMPLXPP_EXPORT int32_t smplxpp_cloth_push_out(int64_t n, float* points, const float* normals, int64_t c, const float* vertices,
                                              const int32_t* faces, int64_t d, float margin, const float* deepest) {
    return smplxpp::guarded([&] {
        smplxpp::check_indices(faces, 3 * d, c);
        Surface surface(c, faces, d);
        const Vec3* skin = (const Vec3*)vertices;
        surface.look(skin);
        for (int64_t i = 0; i < n; ++i) {
            Vec3& p = ((Vec3*)points)[i];
            const Contact contact = surface.find(p, ((const Vec3*)normals)[i]);
            if (contact.face < 0) continue;
            const int32_t* q = faces + 3 * int64_t(contact.face);
            Vec3 foot = {0, 0, 0}, normal = {0, 0, 0};
            float most = 0;
            for (int j = 0; j < 3; ++j) {
                foot = foot + skin[q[j]] * contact.weight[j];
                normal = normal + surface.normal(q[j]) * contact.weight[j];
                most += deepest[q[j]] * contact.weight[j];
            }
            const float l = length(normal);
            if (l < 1e-6f) continue;
            normal = normal * (1.0f / l);
            const float height = dot(p - foot, normal);
            if (height < margin && height > -most) p = p + normal * (margin - height);
        }
    });
}
